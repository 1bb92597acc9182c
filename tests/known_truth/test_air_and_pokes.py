"""A pyramid under turbulence and random pokes: what the model takes for the mean, and its doubt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from small_pyramid import configuration

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.pyramid_model import PyramidModel, nominal_pupils
from escape_sim.pyramid_turbulence import Pokes, strength, unit_screens


@pytest.fixture(scope="module")
def pupils() -> PyramidPupils:
    return nominal_pupils(configuration())


def test_pokes_have_the_structure_function_of_their_spectrum() -> None:
    pokes, n = Pokes(0.8, 24.0), 32
    phases = pokes.phases(400, n)
    assert phases.std() == pytest.approx(0.8, rel=0.02)
    for apart in (2, 4, 8):
        seen = np.mean(np.square(phases[:, :, apart:] - phases[:, :, :-apart]))
        assert seen == pytest.approx(float(pokes.structure(np.array(apart / n))), rel=0.06)


def test_few_modes_or_few_actuators_end_the_spectrum() -> None:
    assert Pokes.of(1.0, 100, 22.0).cutoff == 40.0
    assert Pokes.of(1.0, 94, 9.0).cutoff == pytest.approx(9 * np.pi)


def test_strong_pokes_take_response_away(pupils: PyramidPupils) -> None:
    config = configuration()
    calm = PyramidModel(config, pupils, turbulence=0.0).zonal_matrix(Registration())
    poked = PyramidModel(config, replace(pupils, pokes=0.06), turbulence=0.0).zonal_matrix(Registration())
    share = np.vdot(calm, poked) / np.vdot(calm, calm)
    assert 0.2 < share < 0.8


def test_the_mean_response_beside_pokes_is_that_of_frames(pupils: PyramidPupils) -> None:
    config = configuration()
    model = PyramidModel(config, replace(pupils, pokes=0.04), turbulence=0.0)
    optics, x = model.optics(), model._pupil.coordinates_m
    shape = np.random.default_rng(4).standard_normal(model.n_act)
    surfaces = model._influence(1.0).surfaces(Registration(), model.sub_aperture_m, x, x)
    path = 2 * config.devices.dm.stroke_m * np.tensordot(shape, surfaces, 1)
    want = model.zonal_matrix(Registration()) @ shape
    step = 0.01 * config.system.wavelength_m / path.std()
    seen = []
    for phase in model._pokes.phases(300, x.size) * (config.system.wavelength_m / (2 * np.pi)):
        up, down = (
            slopes_of_image(optics.frame((phase + sign * step * path).astype(np.float32)), pupils)
            for sign in (1, -1)
        )
        seen.append((up - down) / (2 * step))
    mean = np.mean(seen, axis=0)
    noise = np.std(seen, axis=0).mean() / np.sqrt(len(seen))
    assert np.sqrt(np.mean(np.square(mean - want))) < 0.03 * np.std(want) + 1.5 * noise
    assert np.vdot(mean, want) / np.vdot(want, want) == pytest.approx(1.0, abs=0.02)


def test_what_lasts_tells_the_strength_beside_pokes(pupils: PyramidPupils) -> None:
    model = PyramidModel(configuration(), pupils, turbulence=0.0)
    optics, pokes = model.optics(), Pokes(1.5, 20.0)
    n = optics.amplitude.shape[0]
    found = []
    for share in (0.1, 0.3, 0.5):
        told = strength(optics, replace(pupils, steady=share, motion=0.3), 4.0, pokes)
        found.append(told)
    assert found == sorted(found)
    assert found[0] < 0.7 * found[2]
    air = unit_screens(n, 4.0) * found[1] ** (5 / 6)
    first, second = (
        np.array([
            slopes_of_image(optics.frame((p * optics.wavelength_m / (2 * np.pi)).astype(np.float32)), pupils)
            for p in air + half
        ])
        for half in np.split(pokes.phases(2 * len(air), n), 2)
    )  # fmt: skip
    first, second = first - first.mean(axis=0), second - second.mean(axis=0)
    seen = np.mean(first * second) / np.sqrt(np.mean(first**2) * np.mean(second**2))
    assert seen == pytest.approx(0.3, abs=0.05)


def test_the_doubt_falls_with_the_states_that_were_seen(pupils: PyramidPupils) -> None:
    config, few = configuration(), replace(pupils, looks=4.0, centre_sigma_px=0.01)
    model = PyramidModel(config, few, turbulence=8.0)
    once = model.registration_doubt
    assert (once > 0).all()
    assert 0.5 < once[0] < 30
    assert 0.01 < once[2] < 3
    many = PyramidModel(config, replace(few, looks=400.0, centre_sigma_px=0.0), turbulence=8.0)
    assert many.registration_doubt[2:3] == pytest.approx(once[2:3] / 10)
    still = PyramidModel(config, replace(pupils, centre_sigma_px=0.01), turbulence=8.0)
    assert still.registration_doubt[2] == 0
    assert (many.registration_doubt[3:] < once[3:]).all()
    assert still.registration_doubt[0] == pytest.approx(1.0, rel=0.1)
