"""A pyramid from two actuator pitches and ten degrees away.

`benchmarks/studies/registration/capture_range.py` does a hundred.
"""

from __future__ import annotations

import numpy as np
import pytest
from small_pyramid import configuration

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.calibration.modes.bases import karhunen_loeve
from escape_hw.calibration.sprint.fit import sprint
from escape_sim.models.pyramid import PyramidModel, nominal_pupils

#: Actuator pitch in % of a pixel of the pupil image.
PITCH = 100 * 16 / 5


@pytest.mark.parametrize("number", range(3))
def test_converges_or_reports_that_it_does_not(number: int) -> None:
    config = configuration()
    pupils = nominal_pupils(config)
    model = PyramidModel(config, pupils)
    surfaces, pupil, pixel = model.influence_functions()
    m2c = karhunen_loeve(surfaces, pupil, pixel, 20, 4 * config.system.pupil_m)
    rng = np.random.default_rng(900 + number)
    injected = Registration.from_array(rng.uniform(-1, 1, 5) * [2 * PITCH, 2 * PITCH, 10, 4, 4])
    # Actuators that differ by 5 %, and noise: the model knows of neither.
    acting = (1 + 0.05 * rng.standard_normal(model.n_act))[:, None]
    exact = model.zonal_matrix(injected) @ (acting * m2c)
    sigma = np.full(exact.shape, 0.03 * exact.std())
    data = exact + sigma * rng.standard_normal(exact.shape)
    matrix = InteractionMatrix(
        data.astype(np.float32), sigma.astype(np.float32), m2c, pupils.valid, "small", "push-pull", True
    )
    found = sprint(matrix, model, solver="registration-only", max_iterations=40)
    error = np.abs(found.registration.to_array() - injected.to_array())
    assert found.converged, found.warnings
    assert (error < [0.05 * PITCH, 0.05 * PITCH, 0.5, 2.0, 2.0]).all(), error
