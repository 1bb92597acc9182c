"""Spectrum and amplitudes of random pokes."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.acquisition.pokes import (
    ANTICORRELATION,
    RandomPokes,
    equal_snr_amplitudes,
    select_random_pokes,
)

AMPLITUDE = np.array([0.02, 0.005, 0.01])


def drawn(kind: str, n: int = 20_000) -> np.ndarray:
    pokes = select_random_pokes(kind)(AMPLITUDE, np.random.default_rng(4))
    return np.array([pokes() for _ in range(n)])


@pytest.mark.parametrize("kind", ["white", "anticorrelated"])
def test_they_have_the_requested_rms_and_the_modes_are_independent(kind):
    pokes = drawn(kind)
    np.testing.assert_allclose(pokes.std(axis=0), AMPLITUDE / np.sqrt(3), rtol=0.03)
    correlation = np.corrcoef(pokes.T) - np.eye(3)
    assert np.abs(correlation).max() < 5 / np.sqrt(len(pokes)) * 2


def test_white_pokes_are_what_they_were():
    rng = np.random.default_rng(4)
    want = AMPLITUDE * rng.uniform(-1.0, 1.0, (50, 3))
    np.testing.assert_array_equal(drawn("white", 50), want)
    assert select_random_pokes("equal-snr") is RandomPokes


def test_anticorrelated_pokes_alternate():
    pokes = drawn("anticorrelated") / AMPLITUDE
    by_lag = [np.mean(pokes[k:] * pokes[: len(pokes) - k]) / np.mean(pokes**2) for k in (1, 2)]
    assert by_lag == pytest.approx([-ANTICORRELATION, ANTICORRELATION**2], abs=0.03)


def test_equal_snr_is_equal_and_keeps_the_budget():
    columns = np.random.default_rng(1).standard_normal((40, 6)) * np.array([1, 2, 3, 4, 5, 6])
    amplitude = equal_snr_amplitudes(columns, np.full(6, 1.0), 0.02)
    snr = amplitude * np.linalg.norm(columns, axis=0)
    np.testing.assert_allclose(snr, snr[0])
    assert np.square(amplitude).sum() == pytest.approx(6 * 0.02**2)


def test_equal_snr_respects_the_limits_and_gives_the_rest_to_the_others():
    columns = np.diag([1.0, 10.0, 10.0])
    max_amplitude = np.array([0.01, 1.0, 1.0])
    amplitude = equal_snr_amplitudes(columns, max_amplitude, 0.02)
    assert amplitude[0] == 0.01
    assert amplitude[1] == amplitude[2]
    assert np.square(amplitude).sum() == pytest.approx(0.01**2 + 2 * 0.02**2)
    assert (equal_snr_amplitudes(columns, np.full(3, 1e-3), 0.02) <= 1e-3).all()
