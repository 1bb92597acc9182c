"""Waves that make a circle: points, rates, corrections, and the analysis of a recording."""

from __future__ import annotations

import cmath
import math
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from escape_drivers.pi import wave_table as pi_circle
from escape_drivers.pi.circle import CircleGenerator
from escape_drivers.pi.wave_table import CycleTiming
from escape_hw.api.modulator import Modulation
from escape_hw.errors import SettingRejected

SERVO_S = 50e-6


def test_the_clock_rounds_the_frequency_as_the_manual_says():
    for asked, points in ((500.0, 40), (400.0, 50), (300.0, 67), (303.03, 66), (294.0, 68)):
        turn = pi_circle.nearest_timing(asked, SERVO_S, 4096)
        assert turn == CycleTiming(points, 1)
        assert turn.frequency_hz(SERVO_S) == pytest.approx(1 / (points * 50e-6))
    assert pi_circle.nearest_timing(300.0, SERVO_S, 4096).frequency_hz(SERVO_S) == pytest.approx(
        298.507, abs=1e-3
    )


@given(st.floats(0.01, 1000.0))
def test_a_possible_frequency_is_its_own_nearest(frequency):
    turn = pi_circle.nearest_timing(frequency, SERVO_S, 4096)
    made = turn.frequency_hz(SERVO_S)
    assert pi_circle.nearest_timing(made, SERVO_S, 4096).frequency_hz(SERVO_S) == made
    assert 1 <= turn.points <= 4096
    assert (
        abs(made / frequency - 1) <= 0.51 * (1 if turn.points <= pi_circle.MAX_POINTWISE else 4) / turn.points
    )
    assert turn.points <= pi_circle.MAX_POINTWISE or turn.points % 4 == 0


@pytest.mark.parametrize("frequency_hz", [1100.0, 2 / SERVO_S + 1, 5e4, 1e9])
def test_a_frequency_that_is_too_high_is_refused(frequency_hz: float) -> None:
    stage: Any = SimpleNamespace(min_points=20, max_points=4096)
    travel: Any = SimpleNamespace(servo_s=SERVO_S)
    nothing: Any = None
    circle = CircleGenerator("stage", nothing, stage, travel, {}, nothing)
    with pytest.raises(SettingRejected, match=r"it does up to 1000 Hz"):
        circle.achievable(Modulation(1e-4, frequency_hz))


def response(draw_x: float, draw_y: float, lag_x: float, lag_y: float) -> tuple[complex, complex]:
    return cmath.rect(draw_x, -lag_x), cmath.rect(draw_y, -lag_y)


@given(st.floats(0.3, 1.5), st.floats(0.3, 1.5), st.floats(0, 2), st.floats(0, 2), st.integers(20, 80))
def test_a_stage_that_lags_and_weakens_draws_a_circle_when_that_is_known(x, y, lag_x, lag_y, points):
    turn, known = CycleTiming(points, 1), response(x, y, lag_x, lag_y)
    drive = pi_circle.circle_targets(turn, known)
    spectrum = np.fft.fft(drive, axis=0)
    # The stage: each axis' fundamental is scaled and late.
    for axis in (0, 1):
        spectrum[1, axis] *= known[axis]
        spectrum[-1, axis] *= known[axis].conjugate()
    places = np.fft.ifft(spectrum, axis=0).real
    angle = 2 * np.pi * np.arange(points) / points
    assert places == pytest.approx(np.stack([np.cos(angle), np.sin(angle)], axis=1), abs=1e-9)


@given(st.integers(0, 30), st.floats(0.1, 3), st.floats(-3, 3), st.floats(-50, 50), st.floats(1.0, 5.0))
def test_phasors_are_found_from_any_beginning_and_length(begin, amplitude, phase, mean, turns):
    per_turn = 33.0
    k = begin + np.arange(math.ceil(turns * per_turn))
    track = mean + amplitude * np.cos(2 * np.pi * k / per_turn + phase)
    (found,), (middle,) = pi_circle.fit_phasors(track[:, None], per_turn)
    assert found == pytest.approx(cmath.rect(amplitude, phase + 2 * np.pi * begin / per_turn), abs=1e-9)
    assert middle == pytest.approx(mean, abs=1e-9)


def test_less_than_a_turn_gives_no_result():
    with pytest.raises(ValueError, match="less than a turn"):
        pi_circle.fit_phasors(np.zeros((10, 2)), 11.0)


@given(st.floats(0, 500), st.floats(-3.1, 3.1), st.integers(130, 500))
def test_a_sine_that_the_controller_draws_is_right_to_a_point(radius, phase, quarter):
    turn = CycleTiming(4 * quarter, 1)
    angle = 2 * np.pi * np.arange(turn.points) / turn.points
    wave = 1000 + radius * np.cos(angle + phase)
    drawn = pi_circle.evaluate_sine_table(turn, pi_circle.fit_sine_table(turn, wave))
    assert np.abs(drawn - wave).max() <= radius * math.pi / turn.points * 1.01 + 1e-9


@given(st.floats(0.1, 2), st.floats(0.1, 2), st.floats(-3, 3), st.floats(-3, 3))
def test_corrections_survive_being_written_into_a_file(x, y, lag_x, lag_y):
    known = response(x, y, lag_x, lag_y)
    row = pi_circle.response_to_row(303.03, known)
    assert row[0] == 303.03
    assert pi_circle.response_from_row(row) == pytest.approx(known)
