"""Mirrors with an actuator per lenslet: the response around pokes, which are not tilts of whole lenslets."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.tip_tilt import TipTiltFreeModel
from escape_hw.config.loader import load_system
from escape_sim.models.shack_hartmann import ShackHartmannModel, exposure_parts, nominal_grid


@pytest.mark.slow
def test_shift_from_images_of_pokes(import_study):
    run_realisation = import_study("registration/lenslet_pokes.py").run_realisation
    (row,) = run_realisation("revolt-shwfs", 1, 400, [], fractions=(1.0,))["fractions"]
    # Without noise; the random pokes themselves scatter by 0.03 %.
    assert np.abs(row["pokes"]["error"][:2]).max() < 0.1
    assert np.abs(row["nominal"]["error"][:2]).max() > 0.15


@pytest.mark.slow
def test_shift_from_images_of_a_mirror_that_settles(import_study):
    run_realisation = import_study("registration/lenslet_pokes.py").run_realisation
    (row,) = run_realisation("revolt-shwfs", 1, 400, [], fractions=(1.0,), settling=0.17)["fractions"]
    errors = {name: np.hypot(*row[name]["error"][:2]) for name in ("nominal", "pokes", "settling")}
    assert errors["settling"] < 0.9 * errors["pokes"] < 0.45 * errors["nominal"]


@pytest.mark.parametrize("overlap", [0.0, 0.2, 0.5, 0.8])
def test_parts_of_an_exposure(overlap):
    before, now = np.array([1.0, 0.0]), np.array([0.0, 1.0])
    parts = exposure_parts(before, now, overlap)
    assert sum(share for share, _, _ in parts) == pytest.approx(1.0)
    mean = sum(share * wavefront for share, _, wavefront in parts)
    np.testing.assert_allclose(mean, [overlap, 1 - overlap])
    # If the response does not depend on the wavefront, the weights must not change it.
    assert sum(weight for _, weight, _ in parts) == pytest.approx(1.0)


def test_weights_of_an_exposure_are_those_of_a_regression():
    rng, overlap = np.random.default_rng(1), 0.3
    pokes = rng.standard_normal(4000)
    before = np.roll(pokes, 1)
    responses = (1.0, 0.0)
    signal = np.zeros(pokes.size)
    for response, (share, _, _), rest in zip(
        responses, exposure_parts(before, pokes, overlap), (0.5, 0.0), strict=True
    ):
        signal += response * share * (pokes + rest * (before - pokes))
    mixed = pokes + overlap * (before - pokes)
    found = mixed @ signal / (mixed @ mixed)
    weights = [weight for _, weight, _ in exposure_parts(before, pokes, overlap)]
    assert found == pytest.approx(float(np.dot(weights, responses)), abs=0.02)


@pytest.mark.slow
def test_only_dense_actuators_and_random_pokes_have_such_a_response():
    revolt, razor = (load_system(name) for name in ("revolt-shwfs", "razor-shwfs"))
    m2c = np.eye(revolt.devices.dm.n_act, 3)
    poked = replace(nominal_grid(revolt), motion_px=1.0, pokes=0.01)
    model = ShackHartmannModel(revolt, poked)
    around = model.around_pokes(Registration(), m2c, 0.0)
    assert around is not None
    assert around.around_pokes(Registration(), m2c, 0.0) is None
    # The scale of the modes does not matter: those of a regression with coloured pokes have another one.
    scaled = ShackHartmannModel(revolt, poked).around_pokes(Registration(), 7 * m2c, 0.0)
    assert scaled is not None
    matrices = (one.zonal_matrix(Registration()) for one in (around, scaled))
    np.testing.assert_allclose(*matrices, atol=1e-5)
    assert len(around.variants()) == len(model.variants())
    without_pokes = ShackHartmannModel(revolt, replace(poked, pokes=0.0))
    assert without_pokes.around_pokes(Registration(), m2c, 0.0) is None
    sparse = ShackHartmannModel(razor, replace(nominal_grid(razor), motion_px=1.0, pokes=0.01))
    assert sparse.around_pokes(Registration(), np.eye(razor.devices.dm.n_act, 3), 0.0) is None
    without_tilt = TipTiltFreeModel(model).around_pokes(Registration(), m2c, 0.0)
    assert isinstance(without_tilt, TipTiltFreeModel)
    slopes = without_tilt.zonal_matrix(Registration())[:, 100].reshape(2, -1)
    assert np.abs(slopes.mean(axis=1)).max() < 1e-9 * np.abs(slopes).max()
