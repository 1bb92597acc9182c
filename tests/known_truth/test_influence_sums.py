"""Sums of influence functions, and the matrix of the common shape without its derivatives."""

from __future__ import annotations

import numpy as np
import pytest
from small_pyramid import configuration
from test_sprint_variants import SMALL

from escape_hw.api.registration import Registration
from escape_hw.calibration.modes.derivatives import zonal_sum
from escape_hw.calibration.sprint.influence_shape import InfluenceShape
from escape_hw.calibration.sprint.tip_tilt import TipTiltFreeModel
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model

AT = Registration(10.0, -5.0, 0.5, 1.0, 0.3)


@pytest.fixture(scope="module", params=("lenslets", "exponential", "pyramid", "no tip and tilt"))
def model(request):
    if request.param == "pyramid":
        return make_fast_model(configuration(), None)
    more = ("devices.dm.influence=exponential",) if request.param == "exponential" else ()
    lenslets = make_fast_model(load_system("razor-shwfs", overrides=(*SMALL, *more)), None)
    return TipTiltFreeModel(lenslets) if request.param == "no tip and tilt" else lenslets


def test_a_sum_is_that_of_the_matrices(model):
    factor = np.linspace(0.5, 1.5, model.n_act)
    want = factor * model.zonal_matrix(AT, 1.1) - 2.0 * model.zonal_matrix(Registration(), 0.6)
    found = zonal_sum(model, [(factor, AT, 1.1), (-2.0, Registration(), 0.6)])
    assert np.linalg.norm(found - want) < 2e-6 * np.linalg.norm(want)


def test_the_shaped_matrix_alone_is_that_with_derivatives(model):
    shape = InfluenceShape(model)
    coefficients = np.random.default_rng(0).normal(0, 0.1, shape.n_terms)
    want = shape.linearise(AT, 1.05, coefficients)
    found = shape.matrix(AT, 1.05, coefficients, want.terms)
    assert np.linalg.norm(found - want.matrix) < 2e-6 * np.linalg.norm(found)
