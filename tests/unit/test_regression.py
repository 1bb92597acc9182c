"""Sums of a regression against plain least squares."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.docrime import regression
from escape_hw.calibration.docrime.regression import RegressionSums

N, N_SLOPES, N_MODES = 400, 9, 5


def data(offset=0.0):
    rng = np.random.default_rng(0)
    pokes = rng.standard_normal((N, N_MODES)) + offset
    slopes = pokes @ rng.standard_normal((N_MODES, N_SLOPES)) + rng.normal(0, 0.5, (N, N_SLOPES)) - 2 * offset
    return slopes.astype(np.float32), pokes.astype(np.float32)


@pytest.mark.parametrize("offset", [0.0, 3.0])
def test_blocks_add_up_to_least_squares_with_an_intercept(offset):
    slopes, pokes = data(offset)
    sums = RegressionSums.zeros(N_SLOPES, N_MODES, correlations=True)
    for part in np.array_split(np.arange(N), 7):
        sums.add(slopes[part], pokes[part])
    assert sums.count == N
    about_means = sums.subtract_means()
    design = np.concatenate([pokes, np.ones((N, 1))], axis=1).astype(float)
    answer = np.linalg.lstsq(design, slopes.astype(float), rcond=None)[0]
    matrix = about_means.solve()
    assert matrix == pytest.approx(answer[:-1].T, abs=1e-4)
    inverse = np.diag(np.linalg.inv((pokes - pokes.mean(0)).T.astype(float) @ (pokes - pokes.mean(0))))
    assert about_means.inverse_diagonal() == pytest.approx(inverse, rel=1e-4)
    residual = slopes - design @ answer
    assert about_means.residual_power(matrix) == pytest.approx(residual.T @ residual, rel=1e-3, abs=2e-2)


def test_without_correlations_only_the_diagonal_is_kept():
    slopes, pokes = data(1.0)
    full, lean = (
        RegressionSums.zeros(N_SLOPES, N_MODES, correlations=c).add(slopes, pokes).subtract_means()
        for c in (True, False)
    )
    assert np.array_equal(full.solve(), lean.solve())
    assert lean.residual_power(lean.solve()) == pytest.approx(
        np.diag(full.residual_power(full.solve())), rel=1e-3
    )


def test_empty_sums_are_empty():
    sums = RegressionSums.zeros(3, 2, correlations=True).subtract_means()
    assert sums.count == 0
    assert not sums.gram.any()


@pytest.mark.parametrize("correlations", [True, False])
@pytest.mark.parametrize("limit", [64, 5, 4])
def test_correlations_of_a_few_slopes_are_always_known(monkeypatch, correlations, limit):
    monkeypatch.setattr(regression, "N_SAMPLED_SLOPES", limit)
    slopes, pokes = data(1.0)
    full = RegressionSums.zeros(N_SLOPES, N_MODES, correlations=True).add(slopes, pokes).subtract_means()
    sums = (
        RegressionSums.zeros(N_SLOPES, N_MODES, correlations=correlations).add(slopes, pokes).subtract_means()
    )
    matrix = sums.solve()
    step = {64: 1, 5: 2, 4: 3}[limit]
    rows, power = sums.sample(matrix)
    assert np.array_equal(rows, matrix[::step])
    assert power == pytest.approx(full.residual_power(matrix)[::step, ::step], rel=1e-3, abs=2e-2)
