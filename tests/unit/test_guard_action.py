"""The guard's action on commands beyond the limits, and its report."""

from __future__ import annotations

import numpy as np
import pytest
from guard_cases import PAIRS, N, breaches, guard_with
from numpy.typing import NDArray

from escape_hw.errors import CommandRejected
from escape_hw.safety.limits import MirrorLimits


def test_the_result_is_read_only() -> None:
    guard = guard_with(MirrorLimits())
    command = np.full(N, 0.1)
    safe, _ = guard(command)
    command[:] = 0.9
    assert np.array_equal(guard.last, np.full(N, 0.1))
    with pytest.raises(ValueError, match="read-only"):
        safe[0] = 0.9
    for limited in (
        guard.limit(np.full(N, 3.0))[0],
        guard_with(MirrorLimits(max_slew=0.1)).limit([0.5] * N)[0],
    ):
        assert not limited.flags.writeable


def test_limit_remembers_nothing_before_it_is_accepted() -> None:
    guard = guard_with(MirrorLimits(max_slew=0.1))
    first, _ = guard.limit(np.full(N, 1.0))
    second, _ = guard.limit(np.full(N, 1.0))
    assert np.array_equal(first, second)
    guard.set_last(first)
    third, _ = guard.limit(np.full(N, 1.0))
    np.testing.assert_allclose(third, 0.2)


def test_report_states_what_was_done() -> None:
    command = np.zeros(N)
    command[[4, 5]] = 2.0, -2.0
    _, report = guard_with(MirrorLimits(max_stroke=0.5))(command)
    assert (report.clipped, report.is_unchanged) == (2, False)

    _, report = guard_with(MirrorLimits(disabled=(4,)))(command / 4)
    assert (report.disabled, report.clipped) == (1, 0)

    safe, report = guard_with(MirrorLimits(max_slew=0.1))(command / 4)
    assert report.slewed == 2
    np.testing.assert_allclose(safe[[4, 5]], [0.1, -0.1])

    safe, report = guard_with(MirrorLimits(max_mean=0.1))(np.full(N, 0.6))
    assert report.mean_removed == pytest.approx(0.5)
    np.testing.assert_allclose(safe, 0.1)

    a, b = PAIRS[0]
    steep = np.zeros(N)
    steep[[a, b]] = 0.4, -0.4
    safe, report = guard_with(MirrorLimits(max_neighbour=0.2))(steep)
    assert report.scale == pytest.approx(0.25)
    np.testing.assert_allclose(safe, 0.25 * steep)

    safe, report = guard_with(MirrorLimits(max_abs_sum=0.1 * N))(np.full(N, -0.4))
    assert (report.scale, report.clipped) == (pytest.approx(0.25), 0)
    np.testing.assert_allclose(safe, -0.1)


@pytest.mark.parametrize(
    ("limits", "shape"),
    [
        (MirrorLimits(max_stroke=0.5), 0.5 * np.eye(N)[3]),
        (MirrorLimits(max_mean=0.1), np.full(N, 0.1)),
        (MirrorLimits(max_neighbour=0.1), 0.1 * np.eye(N)[6]),
        (MirrorLimits(max_abs_sum=1.0), np.full(N, 1.0 / N)),
    ],
    ids=["stroke", "mean", "neighbour", "sum"],
)
def test_a_little_beyond_a_limit_is_beyond_it(limits: MirrorLimits, shape: NDArray[np.float64]) -> None:
    within, beyond = 0.98 * shape, 1.02 * shape
    np.testing.assert_array_equal(guard_with(limits)(within)[0], within)
    np.testing.assert_allclose(guard_with(limits)(beyond)[0], shape, atol=1e-6)


def test_one_actuator_far_away_does_not_hold_the_others_back() -> None:
    command = np.full(N, 0.05)
    command[7] = 1.0
    safe, report = guard_with(MirrorLimits(max_slew=0.1))(command)
    assert report.slewed == 1
    assert safe[7] == pytest.approx(0.1)
    np.testing.assert_allclose(np.delete(safe, 7), 0.05)


def test_actuators_that_lag_do_not_let_the_mean_drift() -> None:
    command = np.full(N, 0.1)
    command[0] = -0.1 * (N - 1)
    command *= 0.4
    assert command.mean() == pytest.approx(0)
    limits = MirrorLimits(max_slew=0.05, max_mean=0.005)
    guard = guard_with(limits)
    for _ in range(30):
        before = guard.last
        safe, _ = guard(command)
        assert breaches(limits, before, safe) == []
    np.testing.assert_allclose(safe, command, atol=1e-12)


def test_rounding_never_adds_to_the_stroke() -> None:
    stroke, start = 0.3, -0.28
    assert start + (stroke - start) > stroke
    guard = guard_with(MirrorLimits(max_stroke=stroke, max_slew=0.59))
    guard.reset([start] * (N - 1) + [-stroke])
    safe, report = guard(np.full(N, stroke))
    assert report.slewed == 1
    assert safe.max() == safe[0] == stroke


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_absurd_piston_keeps_its_sign(sign: float) -> None:
    safe, report = guard_with(MirrorLimits(max_mean=0.1))(np.full(N, sign * 1e308))
    np.testing.assert_allclose(safe, sign * 0.1)
    assert np.isfinite(report.mean_removed)


@pytest.mark.parametrize(
    ("limits", "shape", "words"),
    [
        (MirrorLimits(max_stroke=0.5), np.eye(N)[3], "actuator 3 exceeds max_stroke = 0.5"),
        (MirrorLimits(disabled=(6,)), 0.1 * np.eye(N)[6], "actuator 6 is disabled"),
        (MirrorLimits(max_mean=0.1), np.full(N, 0.2), "max_mean = 0.1"),
        (MirrorLimits(max_neighbour=0.1), 0.2 * np.eye(N)[6], "max_neighbour = 0.1"),
        (MirrorLimits(max_abs_sum=1.0), np.full(N, 0.2), "sum of magnitudes exceeds max_abs_sum = 1.0"),
    ],
)
def test_breach_names_the_rule(limits: MirrorLimits, shape: NDArray[np.float64], words: str) -> None:
    guard = guard_with(limits)
    told = guard.find_violation(shape)
    assert told is not None
    assert words in told
    assert guard.find_violation(np.zeros(N)) is None


def test_reset_takes_the_shape_found_and_refuses_nonsense() -> None:
    guard = guard_with(MirrorLimits(max_slew=0.1))
    guard.reset(np.full(N, 0.5))
    np.testing.assert_allclose(guard(np.zeros(N))[0], 0.4)
    with pytest.raises(CommandRejected, match="not finite"):
        guard.reset(np.full(N, np.nan))
    guard.reset()
    assert not guard.last.any()
