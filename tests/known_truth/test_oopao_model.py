"""The fast synthetic model against OOPAO's, and both against OOPAO's own interaction matrix."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_system import GAUSSIAN

from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig
from escape_hw.errors import CalibrationError
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import nominal_grid
from escape_sim.oopao import models as oopao_model
from escape_sim.oopao.library import make_lenslets, suppress_output

PAPER = Registration(-16.0, -71.0, -0.77, 2.9, 0.0)
#: Relative, with no gain or any other freedom; 5e-8 is what we see.
TOLERANCE = 1e-6


@pytest.fixture(scope="module")
def config() -> SystemConfig:
    return load_system("razor-shwfs", overrides=GAUSSIAN)


@pytest.fixture(scope="module")
def oopao(config):
    return oopao_model.make_oopao_model(config, None)


@pytest.fixture(scope="module")
def paper(oopao):
    return oopao.zonal_matrix(PAPER)


@pytest.fixture(scope="module")
def fast(config):
    return make_fast_model(config, None)


def difference(ours, theirs) -> float:
    return float(np.linalg.norm(ours - theirs) / np.linalg.norm(theirs))


def test_both_are_synthetic_models(oopao, fast):
    for model in (oopao, fast):
        assert isinstance(model, SyntheticModel)
        assert model.n_act == 97
        assert model.sub_aperture_m == pytest.approx(6.75e-3 / 24)
    assert (oopao.name, fast.name) == ("oopao", "fast")


@pytest.mark.parametrize("registration", [Registration(), Registration(90.0, 80.0, 2.0, -4.0, 4.0)])
@pytest.mark.slow
def test_matrices_are_equal(oopao, fast, registration):
    theirs = oopao.zonal_matrix(registration)
    assert theirs.shape == (theirs.shape[0], 97)
    assert np.abs(theirs).max() > 0.1
    assert difference(fast.zonal_matrix(registration), theirs) < TOLERANCE


@pytest.mark.slow
def test_matrices_are_equal_for_another_width(oopao, fast):
    theirs = oopao.zonal_matrix(PAPER, 1.05)
    assert difference(fast.zonal_matrix(PAPER, 1.05), theirs) < TOLERANCE
    assert difference(fast.zonal_matrix(PAPER), theirs) > 1e-2


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "step"),
    [
        ("rotation", 0.2),
        ("shift_x", 2.0),
        ("shift_y", 2.0),
        ("radial_scaling", 0.5),
        ("tangential_scaling", 0.5),
    ],
)
def test_sensitivities_are_equal(oopao, fast, name, step):
    # What SPRINT inverts: a thousandth of a difference here would be a thousandth in the answer.
    here, there = (replace(PAPER, **{name: getattr(PAPER, name) + s}) for s in (step, -step))
    ours, theirs = (m.zonal_matrix(here) - m.zonal_matrix(there) for m in (fast, oopao))
    assert difference(ours, theirs) < 10 * TOLERANCE


@pytest.mark.slow
def test_matrices_are_equal_on_a_grid_found_elsewhere(config, fast):
    nominal = nominal_grid(config)
    valid = nominal.valid.copy()
    valid[5:9, 3:7] = False
    grid = replace(
        nominal,
        pitch_px=15.55,
        origin_px=(nominal.origin_px[0] + 3.3, nominal.origin_px[1] - 2.1),
        valid=valid,
        references_px=np.zeros((int(valid.sum()), 2), np.float32),
    )
    ours, theirs = (
        make(config, grid).zonal_matrix(PAPER) for make in (make_fast_model, oopao_model.make_oopao_model)
    )
    assert ours.shape == (2 * int(valid.sum()), 97)
    assert difference(ours, theirs) < TOLERANCE


def test_influence_functions_are_equal(oopao, fast):
    theirs, pupil, pixel = oopao.influence_functions()
    ours, our_pupil, our_pixel = fast.influence_functions()
    step = round(our_pixel / pixel)
    # The fast model's are sampled more coarsely: at the mean position of step x step samples.
    n = ours.shape[1]
    binned = theirs.reshape(97, n, step, n, step).mean(axis=(2, 4))
    assert np.abs(binned - ours).max() < 2e-3
    assert np.mean(pupil.reshape(n, step, n, step).mean(axis=(1, 3))[our_pupil]) > 0.98


def test_the_matrix_is_that_of_oopao_itself(config, oopao, paper):
    """OOPAO's own calibration routine with its own centroids, over its own whole-pixel windows."""
    from OOPAO.calibration.InteractionMatrix import InteractionMatrix

    light = oopao._light
    lenslets = make_lenslets(light, 24, 14)
    with suppress_output():
        mirror = oopao.registered_mirror(PAPER, 1.0)
        own = InteractionMatrix(
            light.source,
            light.telescope,
            mirror,
            lenslets,
            np.eye(97),
            stroke=1e-9,
            nMeasurements=16,
            invert=False,
            single_pass=False,
        ).D
    lit = lenslets.sh_data["src_0"].valid_subapertures
    keep = nominal_grid(config).valid[lit]
    # Metres of path to commands, OOPAO's pixels to the camera's.
    scale = 2 * config.devices.dm.stroke_m * config.sensor.spot_px / 2
    theirs = own[np.concatenate([keep, keep])] * scale
    ours = paper
    # Its lenslets do not shine on their neighbours, and its windows are 7 lambda/d wide where the
    # camera's are 15 or 16 pixels, 6.5 or 7: up to a gain of each slope, 2 % remain.
    gain = (ours * theirs).sum(axis=1) / (theirs * theirs).sum(axis=1)
    assert difference(ours, gain[:, None] * theirs) < 3e-2
    assert np.median(gain) == pytest.approx(1.0, abs=0.1)
    assert gain.std() < 0.05


@pytest.mark.slow
def test_the_matrix_does_not_depend_on_the_order_of_calls(oopao, fast, paper):
    assert difference(fast.zonal_matrix(PAPER), paper) < TOLERANCE
    oopao.zonal_matrix(Registration(50.0, 0.0, 1.0, 0.0, 0.0), 0.9)
    assert np.array_equal(oopao.zonal_matrix(PAPER), paper)


def test_a_grid_of_another_size_is_refused(config):
    nominal = nominal_grid(config)
    small = replace(nominal, valid=nominal.valid[:-1, :-1])
    with pytest.raises(CalibrationError, match="n_sub is 24"):
        oopao_model.make_oopao_model(config, small)


def test_a_grid_outside_the_pupil_is_refused(config):
    nominal = nominal_grid(config)
    with pytest.raises(CalibrationError, match="outside the design's pupil"):
        oopao_model.make_oopao_model(config, replace(nominal, valid=np.ones_like(nominal.valid)))
