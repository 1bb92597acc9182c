"""Slope weights: contamination of a telescope's pupil does not bias the registration."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from small_pyramid import configuration as small_pyramid

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.calibration.sprint.forwarding import Forwarding
from escape_hw.config.choices import Solver
from escape_hw.config.loader import load_system
from escape_sim.models.pyramid import PyramidModel, nominal_pupils

#: Noise of an element, relative to the rms of the matrix.
NOISE = 0.05


class Selective(Forwarding):
    """The same model with a weight per slope."""

    slope_weights: NDArray[np.float64] = np.ones(0)

    def __init__(self, model: PyramidModel, weights: NDArray[np.float64]) -> None:
        super().__init__(model)
        self.slope_weights = weights


def contaminated(pupils: PyramidPupils) -> NDArray[np.bool_]:
    """Valid pixels in the outer fifth of a quarter of the pupil ``(n_valid,)``."""
    y, x = (np.argwhere(pupils.valid) + 0.5 - len(pupils.valid) / 2).T
    return (np.hypot(x, y) > 0.4 * len(pupils.valid)) & (x > np.abs(y))


def errors(selective: bool, solver: Solver = "mixed-effects") -> NDArray[np.float64]:
    """Errors ``(6, 5)`` for contaminated pixels with half the response of their neighbours."""
    config = small_pyramid()
    pupils = nominal_pupils(config)
    model, dirty = PyramidModel(config, pupils), np.tile(contaminated(pupils), 2)
    weights = np.where(dirty, 1e-3, 1.0)
    out = []
    for seed in range(6):
        rng = np.random.default_rng(seed)
        truth = Registration(*(rng.uniform(-1, 1, 5) * [20, 20, 0.5, 1.5, 1.5]))
        zonal = model.zonal_matrix(truth)
        zonal[dirty] = (
            0.5 * model.zonal_matrix(replace(truth, radial_scaling=truth.radial_scaling + 12))[dirty]
        )
        noise = NOISE * zonal.std()
        matrix = InteractionMatrix(
            (zonal + noise * rng.standard_normal(zonal.shape)).astype(np.float32),
            np.full(zonal.shape, noise, np.float32), np.eye(model.n_act), pupils.valid,
            "small", "push-pull", True,
        )  # fmt: skip
        found = sprint(matrix, Selective(model, weights) if selective else model, solver=solver)
        # With all slopes the solvers without random effects state that the model does not fit.
        assert found.converged or not selective
        out.append(found.registration.to_array() - truth.to_array())
    return np.array(out)


@pytest.mark.parametrize(
    "solver",
    [pytest.param("mixed-effects", marks=pytest.mark.slow), "registration-only", "frozen-derivatives"],
)
def test_slopes_of_small_weight_do_not_move_the_registration(solver: Solver) -> None:
    with_all, without = (np.sqrt(np.mean(np.square(errors(one, solver)), axis=0)) for one in (False, True))
    # Scaling along x, the way the contaminated pixels look; a clean fit errs by hundredths of a per cent.
    assert with_all[3] > 0.3
    assert without[3] < with_all[3] / 4
    assert without[0] < with_all[0]


@pytest.mark.parametrize(("system", "telescope"), [("maps-nir", True), ("razor-pywfs", False)])
def test_only_a_telescopes_model_reduces_the_weight_of_dim_pixels(system: str, telescope: bool) -> None:
    config = load_system(system, overrides=["sensor.n_sub=24", "basis.n_modes=20"])
    pupils = nominal_pupils(config)
    arc = np.zeros(pupils.valid.shape, bool)
    arc[pupils.valid] = contaminated(pupils)
    model = PyramidModel(config, replace(pupils, flux=np.where(arc, 0.4, 1.0).astype(np.float32)))
    trusted = model.slope_weights == 1.0
    expected = ~contaminated(pupils) if telescope else np.ones(pupils.valid.sum(), bool)
    np.testing.assert_array_equal(trusted, np.tile(expected, 2))
    assert (model.slope_weights > 0).all()


def test_a_pupil_that_is_dim_everywhere_has_full_weights() -> None:
    config = load_system("maps-nir", overrides=["sensor.n_sub=24", "basis.n_modes=20"])
    pupils = nominal_pupils(config)
    dim = np.where(np.random.default_rng(1).random(pupils.valid.shape) < 0.7, 0.5, 1.0)
    assert (PyramidModel(config, replace(pupils, flux=dim.astype(np.float32))).slope_weights == 1.0).all()
