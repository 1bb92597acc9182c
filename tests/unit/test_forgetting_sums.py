"""Pokes as instruments: matrices from a closed loop, where least squares is biased."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.calibration.docrime.regression import ForgettingSums

N_SLOPES, N_MODES = 24, 6


def frame_of(matrix):
    valid = np.ones((1, N_SLOPES // 2), bool)
    return InteractionMatrix(
        matrix.astype(np.float32), np.zeros(matrix.shape, np.float32), np.eye(N_MODES), valid, "x", "y", True
    )


def closed_loop(rng, truth, frames, poke=0.1, gain=0.5):
    """Slopes, commands and pokes of a loop whose turbulence remembers what a filter did not take out."""
    back = np.linalg.pinv(truth)
    state, turbulence = np.zeros(N_MODES), np.zeros(N_SLOPES)
    rows = []
    for _ in range(frames):
        turbulence = 0.6 * turbulence + rng.standard_normal(N_SLOPES)
        z = poke * rng.uniform(-1, 1, N_MODES)
        x = state + z
        y = truth @ x + turbulence
        rows.append((y, x, z))
        state = 0.98 * state - gain * back @ y
    return tuple(np.stack(part).astype(np.float32) for part in zip(*rows, strict=True))


def solved(sums, matrix, rounds=5):
    """The plain matrix that the sums hold: least squares on the turned columns, again and again."""
    for _ in range(rounds):
        columns = sums.build_columns(frame_of(matrix), matrix)
        matrix = columns.data.astype(float) @ np.linalg.pinv(columns.m2c)
    return matrix


@pytest.fixture
def truth():
    return np.random.default_rng(1).standard_normal((N_SLOPES, N_MODES))


def test_instruments_are_right_where_least_squares_is_not(truth):
    rng = np.random.default_rng(2)
    y, x, z = closed_loop(rng, truth, 20_000)
    sums = ForgettingSums.zeros(N_SLOPES, N_MODES)
    sums.add(y, x, z, truth.astype(np.float32))
    by_least_squares = np.linalg.lstsq(x, y)[0].T

    def gain(matrix):
        return np.vdot(truth, matrix) / np.vdot(truth, truth)

    assert gain(by_least_squares) < 0.8
    assert gain(solved(sums, 0.7 * truth)) == pytest.approx(1.0, abs=0.02)


def test_errors_of_forgetting_sums_are_correct(truth):
    rng = np.random.default_rng(4)
    chi2 = []
    for _ in range(30):
        sums = ForgettingSums.zeros(N_SLOPES, N_MODES)
        for _ in range(12):
            y = rng.standard_normal((60, N_SLOPES))
            z = rng.uniform(-1, 1, (60, N_MODES))
            y = (y + z @ truth.T).astype(np.float32)
            sums.forget(0.7)
            sums.add(y, z.astype(np.float32), z.astype(np.float32), truth.astype(np.float32))
        columns = sums.build_columns(frame_of(truth), truth)
        left = (columns.data - truth @ columns.m2c) / columns.sigma
        chi2.append(np.mean(np.square(left)))
    assert np.mean(chi2) == pytest.approx(1.0, abs=0.05)


def test_in_open_loop_they_are_least_squares(truth):
    rng = np.random.default_rng(5)
    z = rng.uniform(-1, 1, (300, N_MODES)).astype(np.float32)
    y = (z @ truth.T + rng.standard_normal((300, N_SLOPES))).astype(np.float32)
    sums = ForgettingSums.zeros(N_SLOPES, N_MODES)
    sums.add(y, z, z, truth.astype(np.float32))
    centred = z - z.mean(axis=0)
    expected = np.linalg.lstsq(centred, y - y.mean(axis=0))[0].T
    np.testing.assert_allclose(solved(sums, truth, 1), expected, rtol=1e-3, atol=1e-4)


def test_forgetting_and_merging_are_weights(truth):
    rng = np.random.default_rng(6)
    parts = [closed_loop(rng, truth, 50) for _ in range(2)]
    thin = truth.astype(np.float32)
    one, two, both = (ForgettingSums.zeros(N_SLOPES, N_MODES) for _ in range(3))
    one.add(*parts[0], thin)
    two.add(*parts[1], thin)
    both.add(*parts[0], thin)
    both.forget(0.5)
    both.merge(two)
    np.testing.assert_allclose(both.cross, 0.5 * one.cross + two.cross)
    np.testing.assert_allclose(both.gram, 0.25 * one.gram + two.gram)
    assert both.weight == 75
