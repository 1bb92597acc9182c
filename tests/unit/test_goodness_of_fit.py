"""Whether a model fits, and where it does not, from the residual of a fit."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from escape_hw.calibration.sprint.goodness_of_fit import (
    NOT_JUDGED,
    Misfit,
    assess_fit,
    describe_misfit,
    describe_outliers,
)
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

VALID = np.ones((6, 6), dtype=bool)
N_MODES = 20


def weighted_matrix(signal: float) -> WeightedMatrix:
    """Slopes of ``signal`` standard errors rms, in noise."""
    rng = np.random.default_rng(0)
    data = signal * rng.standard_normal((72, N_MODES)) + rng.standard_normal((72, N_MODES))
    return WeightedMatrix(data, np.ones(72), np.ones(N_MODES), np.eye(N_MODES), True, VALID)


@pytest.mark.parametrize(
    ("signal", "misfit", "noise", "fits"),
    [
        (100.0, 0.0, 1.0, True),
        (100.0, 0.05, 1.0, False),
        (100.0, 0.3, 1.0, False),
        # A small part of a bright matrix, although its reduced chi-squared is 3.
        (1000.0, 0.0014, 1.0, True),
        # Standard errors that are somewhat too small are no misfit, however large a part of a faint matrix.
        (3.0, 0.0, 1.08, True),
    ],
)
def test_a_model_that_does_not_fit_is_told(signal: float, misfit: float, noise: float, fits: bool) -> None:
    weighted, rng = weighted_matrix(signal), np.random.default_rng(1)
    residual = noise * rng.standard_normal(weighted.data.shape)
    residual += signal * misfit * rng.standard_normal(residual.shape)
    found = assess_fit(weighted, residual, {})
    assert found is not None
    assert found.fits is fits
    notes = describe_misfit(weighted, residual, {})
    assert len(notes) == (not fits)
    if not fits:
        assert found.misfit == pytest.approx(misfit, rel=0.1)
        assert f"the model does not fit: {found.misfit:.0%} of the matrix" in notes[0]


def test_correlated_noise_of_a_few_columns_is_no_misfit() -> None:
    """A common pattern in every column, as of turbulence: the mean square is hardly known."""
    weighted, rng = weighted_matrix(10.0), np.random.default_rng(5)
    pattern = np.tile(np.cos(np.linspace(0, 6, 36)), 2) * np.sqrt(2)
    residual = np.outer(pattern, rng.standard_normal(N_MODES))
    assert Misfit.of(weighted, residual).excess_sigma > 0.1
    found = assess_fit(weighted, residual, {})
    assert found is not None
    assert found.fits


def test_slopes_with_a_small_weight_do_not_hide_a_misfit() -> None:
    rng = np.random.default_rng(1)
    weights = np.tile(np.where(np.arange(36) < 12, 1e-3, 1.0), 2)
    weighted = weighted_matrix(100.0).with_slope_weights(weights)
    residual = np.sqrt(weights)[:, None] * rng.standard_normal(weighted.data.shape)
    assert weighted.reduced_chi_squared(residual) == pytest.approx(1.0, abs=0.1)
    found = assess_fit(weighted, residual, {})
    assert found is not None
    assert found.by_sub_aperture == pytest.approx(1.0, abs=0.4)
    assert found.by_actuator == pytest.approx(1.0, abs=0.4)


def test_a_matrix_without_standard_errors_is_not_judged() -> None:
    weighted = replace(weighted_matrix(100.0), has_standard_errors=False)
    residual = 5 * np.random.default_rng(1).standard_normal(weighted.data.shape)
    assert assess_fit(weighted, residual, {}) is None
    assert describe_misfit(weighted, residual, {}) == (NOT_JUDGED,)


@pytest.mark.parametrize("has_standard_errors", [True, False])
def test_effects_that_scatter_by_more_than_their_priors_can_are_a_misfit(has_standard_errors: bool) -> None:
    weighted = replace(weighted_matrix(100.0), has_standard_errors=has_standard_errors)
    residual = np.random.default_rng(1).standard_normal(weighted.data.shape)
    excess = {"actuator_gain": 2.8, "actuator_width": 1.3}
    found = assess_fit(weighted, residual, excess)
    assert found is not None
    assert found.fits is False
    note = describe_misfit(weighted, residual, excess)[0]
    assert "the gains of the actuators (2.8 times)" in note
    assert "contain a factor of 2.8" in note


def test_the_worst_parts_are_named() -> None:
    weighted, rng = weighted_matrix(100.0), np.random.default_rng(1)
    residual = rng.standard_normal(weighted.data.shape)
    residual[[7, 36 + 7]] += 40 * rng.standard_normal((2, N_MODES))
    residual[:, 3] += 20 * rng.standard_normal(72)
    named = describe_outliers(weighted, residual)
    assert "sub-apertures (row, column) (1, 1)" in named
    assert "actuators 3" in named
    found = assess_fit(weighted, residual, {})
    assert found is not None
    assert int(found.by_sub_aperture.argmax()) == 7
    assert int(found.by_actuator.argmax()) == 3
