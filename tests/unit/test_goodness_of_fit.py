"""Notes and refusals from the residual of a fit."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.sprint.goodness_of_fit import describe_misfit, describe_outliers, misfit_fraction
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

VALID = np.ones((6, 6), dtype=bool)
N_MODES = 20


def weighted_matrix(signal: float) -> WeightedMatrix:
    """Slopes of ``signal`` standard errors rms, in noise."""
    rng = np.random.default_rng(0)
    data = signal * rng.standard_normal((72, N_MODES)) + rng.standard_normal((72, N_MODES))
    return WeightedMatrix(data, np.ones(72), np.ones(N_MODES), np.eye(N_MODES), True, VALID)


@pytest.mark.parametrize(("misfit", "told"), [(0.0, False), (0.05, True), (0.3, False)])
def test_a_model_that_does_not_fit_to_within_the_noise_is_told(misfit, told):
    """A large misfit is a reason to refuse the result, and no note."""
    weighted, rng = weighted_matrix(100.0), np.random.default_rng(1)
    residual = rng.standard_normal(weighted.data.shape)
    residual += 100 * misfit * rng.standard_normal(residual.shape)
    assert misfit_fraction(weighted, residual) == pytest.approx(misfit, rel=0.1)
    notes = describe_misfit(weighted, residual)
    assert len(notes) == told
    assert not told or "does not fit to within the noise: 5% of the matrix" in notes[0]


def test_the_worst_parts_are_named():
    weighted, rng = weighted_matrix(100.0), np.random.default_rng(1)
    residual = rng.standard_normal(weighted.data.shape)
    residual[[7, 36 + 7]] += 40 * rng.standard_normal((2, N_MODES))
    residual[:, 3] += 20 * rng.standard_normal(72)
    named = describe_outliers(weighted, residual)
    assert "sub-apertures (row, column) (1, 1)" in named
    assert "actuators 3" in named
