"""Slopes of a pyramid whose gain increases towards the rim, against injected values."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage
from small_pyramid import configuration as small_pyramid
from small_system import configuration as small_lenslets

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.fit import SprintFit, fit_registration
from escape_hw.calibration.sprint.forwarding import Forwarding
from escape_hw.calibration.sprint.mixed_effects import slope_trends
from escape_sim.models.factory import make_fast_model
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.models.shack_hartmann import nominal_grid

SEEDS = range(3)
#: Noise of an element, relative to the rms of the matrix.
NOISE = 0.3
#: From the centre to the rim, along x and y of the x slopes, then of the y slopes: as on `razor-pywfs`.
TREND = np.array([0.09, 0.29, 0.22, 0.07])


class Even(Forwarding):
    """The same model, sure that its slopes have no trend."""

    gain_trend = 0.0


@pytest.fixture(scope="module")
def model() -> PyramidModel:
    config = small_pyramid()
    return PyramidModel(config, nominal_pupils(config), turbulence=5.0)


def unit_trends(model: PyramidModel) -> NDArray[np.float64]:
    """Slopes by trends of 1 from the centre to the rim."""
    valid = nominal_pupils(small_pyramid()).valid
    return slope_trends(model, valid) / model.gain_trend


def measured(
    model: PyramidModel, seed: int, trend: NDArray[np.float64], noise: float = NOISE
) -> tuple[InteractionMatrix, Registration]:
    """A matrix of unequal actuators and slopes, with correlated noise of neighbours, and the true values."""
    rng, valid = np.random.default_rng(seed), nominal_pupils(small_pyramid()).valid
    truth = Registration(*(rng.uniform(-1, 1, 5) * [20, 20, 0.5, 1.5, 1.5]))
    zonal_matrix = model.zonal_matrix(truth) * (1 + 0.05 * rng.standard_normal(model.n_act))
    zonal_matrix *= (1 + 0.05 * rng.standard_normal(len(zonal_matrix)) + unit_trends(model) @ trend)[:, None]
    white = rng.standard_normal((model.n_act, 2, *valid.shape))
    smooth = ndimage.gaussian_filter(white, (0, 0, 1.5, 1.5))[:, :, valid].reshape(model.n_act, -1).T
    sigma = noise * zonal_matrix.std()
    data = zonal_matrix + sigma * smooth / smooth.std()
    return InteractionMatrix(
        data.astype(np.float32), np.full(zonal_matrix.shape, sigma, np.float32), np.eye(model.n_act), valid,
        "razor-pywfs", "docrime", True,
    ), truth  # fmt: skip


def fitted(matrix: InteractionMatrix, model: object) -> SprintFit:
    return run(fit_registration(matrix, model, update_priors=True))


def error_of(fit: SprintFit, truth: Registration) -> NDArray[np.float64]:
    return fit.estimate.registration.to_array() - truth.to_array()


def test_an_injected_trend_is_recovered(model: PyramidModel) -> None:
    pulls, shapes = [], []
    terms = np.column_stack([np.ones(len(unit_trends(model))), unit_trends(model)])
    for seed in SEEDS:
        matrix, truth = measured(model, seed, TREND, noise=0.1)
        fit = fitted(matrix, model)
        assert fit.estimate.converged, fit.estimate.warnings
        pulls.append(error_of(fit, truth) / fit.estimate.sigma)
        nominal = model.zonal_matrix(truth)
        answers = (fit.zonal_matrix() * nominal).sum(axis=1) / np.square(nominal).sum(axis=1)
        told = np.linalg.lstsq(terms, answers)[0]
        shapes.append(told[1:] / told[0])
    assert np.mean(shapes, axis=0) == pytest.approx(TREND, abs=0.03)
    assert np.mean(np.square(pulls)) < 2.0


@pytest.mark.slow
def test_a_trend_is_not_fitted_as_a_scaling(model: PyramidModel) -> None:
    # The same noise and the same mirror, with and without a trend.
    def moved(one: object) -> NDArray[np.float64]:
        found = []
        for seed in SEEDS:
            with_trend, none = (
                error_of(fitted(matrix, one), truth)
                for matrix, truth in (measured(model, seed, trend) for trend in (TREND, np.zeros(4)))
            )
            found.append(with_trend - none)
        return np.asarray(np.mean(found, axis=0))

    with_unknown, without = moved(model), moved(Even(model))
    assert (without[3:] > 0.04).all()
    assert (np.abs(with_unknown[3:]) < 0.03).all()


@pytest.mark.slow
def test_no_trend_is_found_where_there_is_none(model: PyramidModel) -> None:
    found = []
    for seed in SEEDS:
        matrix, truth = measured(model, seed, np.zeros(4))
        both = [fitted(matrix, one).estimate for one in (model, Even(model))]
        found.append([(one.registration.to_array() - truth.to_array()) for one in both])
        # What might be a trend makes a scaling a little less certain, no more.
        assert (both[0].sigma[3:] < 1.5 * both[1].sigma[3:]).all()
    rms = np.sqrt(np.mean(np.square(found), axis=0))
    assert (rms[0][3:] < 1.6 * rms[1][3:] + 0.02).all()


def test_only_a_pyramid_under_turbulence_or_pokes_has_trends(model: PyramidModel) -> None:
    config = small_lenslets()
    lenslets, grid = make_fast_model(config, None), nominal_grid(config)
    assert slope_trends(lenslets, grid.valid).shape == (grid.n_slopes, 0)
    at_rest = PyramidModel(small_pyramid(), nominal_pupils(small_pyramid()))
    assert at_rest.gain_trend == 0.0
    assert unit_trends(model).mean(axis=0) == pytest.approx(np.zeros(4), abs=1e-12)


def test_the_noise_that_lenslets_share_is_left_as_it_was() -> None:
    config = small_lenslets()
    lenslets, grid = make_fast_model(config, None), nominal_grid(config)
    zonal_matrix = lenslets.zonal_matrix(Registration(5.0, -3.0))
    rng = np.random.default_rng(0)
    # Noise that all slopes share, which a pyramid's fit would count.
    sigma = 0.1 * zonal_matrix.std()
    data = zonal_matrix + sigma * rng.standard_normal((1, lenslets.n_act))
    matrix = InteractionMatrix(
        data.astype(np.float32), np.full(zonal_matrix.shape, sigma, np.float32), np.eye(lenslets.n_act),
        grid.valid, "razor-shwfs", "docrime", True,
    )  # fmt: skip
    estimate_priors = run(fit_registration(matrix, lenslets)).estimate_priors
    assert estimate_priors is not None
    assert estimate_priors().priors.noise_inflation == 1.0
