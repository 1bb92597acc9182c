"""A pyramid under turbulence and random pokes: the mean response and its uncertainty."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from small_pyramid import configuration

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.pipeline.slopes.pyramid import slopes_of_image
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.models.pyramid_turbulence import PokePhase, estimate_strength, unit_screens


@pytest.fixture(scope="module")
def pupils() -> PyramidPupils:
    return nominal_pupils(configuration())


def poked(pupils: PyramidPupils, rms: float, turbulence: float | None = 0.0) -> PyramidModel:
    """The model of a sensor that saw pokes of ``rms`` of the stroke on all modes together."""
    return PyramidModel(configuration(), replace(pupils, pokes=rms), turbulence=turbulence)


def random_pokes(model: PyramidModel) -> PokePhase:
    assert model._pokes is not None
    return model._pokes


def test_pokes_have_the_structure_function_of_their_phases(pupils: PyramidPupils) -> None:
    pokes = random_pokes(poked(pupils, 0.04))
    phases, lit = pokes.phases(400), pokes.lit
    inside = phases[:, lit]
    rms = np.sqrt(pokes.modes_rad[:, lit].var(axis=1).sum())
    assert np.sqrt(inside.var(axis=1).mean()) == pytest.approx(rms, rel=0.05)
    structure, pairs = pokes.pair_structure(), np.random.default_rng(3).integers(lit.sum(), size=(2, 400))
    assert np.abs(np.diag(structure)).max() < 1e-5 * structure.max()
    seen = np.square(inside[:, pairs[0]] - inside[:, pairs[1]]).mean(axis=0)
    assert seen.mean() == pytest.approx(structure[tuple(pairs)].mean(), rel=0.02)
    assert seen == pytest.approx(structure[tuple(pairs)], rel=0.3)


def test_pokes_are_shared_among_modes_as_far_as_their_actuators_go() -> None:
    modes = np.random.default_rng(0).standard_normal((4, 8, 8))
    lit = np.ones((8, 8), bool)
    pokes = PokePhase.from_rms(0.1, np.array([1.0, 1.0, 0.02, 1.0]), modes, lit)
    amplitude = np.sqrt(np.square(pokes.modes_rad / modes).mean(axis=(1, 2)))
    assert amplitude[2] == pytest.approx(0.02, rel=1e-6)
    assert amplitude[[0, 1, 3]] == pytest.approx(np.sqrt((0.01 - 0.0004) / 3), rel=1e-6)
    # Asked for more than the limits leave, as by hand: all of them grow alike.
    more = PokePhase.from_rms(2.0, np.array([1.0, 1.0, 0.02, 1.0]), modes, lit)
    assert np.square(more.modes_rad / modes).mean(axis=(1, 2)).sum() == pytest.approx(4.0)


def test_strong_pokes_take_response_away(pupils: PyramidPupils) -> None:
    calm = PyramidModel(configuration(), pupils, turbulence=0.0).zonal_matrix(Registration())
    shaken = poked(pupils, 0.06).zonal_matrix(Registration())
    assert 0.2 < np.vdot(calm, shaken) / np.vdot(calm, calm) < 0.8


def test_the_mean_response_beside_pokes_is_that_of_frames(pupils: PyramidPupils) -> None:
    config, model = configuration(), poked(pupils, 0.04)
    optics, x = model.optics(), model._pupil.coordinates_m
    shape = np.random.default_rng(4).standard_normal(model.n_act)
    surfaces = model._surfaces(x)
    path = 2 * config.devices.dm.stroke_m * np.tensordot(shape, surfaces, 1)
    want = model.zonal_matrix(Registration()) @ shape
    step = 0.01 * config.system.wavelength_m / path.std()
    seen = []
    for phase in random_pokes(model).phases(300) * (config.system.wavelength_m / (2 * np.pi)):
        up, down = (
            slopes_of_image(optics.frame((phase + sign * step * path).astype(np.float32)), pupils)
            for sign in (1, -1)
        )
        seen.append((up - down) / (2 * step))
    mean = np.mean(seen, axis=0)
    noise = np.std(seen, axis=0).mean() / np.sqrt(len(seen))
    assert np.sqrt(np.mean(np.square(mean - want))) < 0.02 * np.std(want) + 1.5 * noise
    assert np.vdot(mean, want) / np.vdot(want, want) == pytest.approx(1.0, abs=0.015)


@pytest.mark.slow
def test_pokes_that_move_the_rim_more_make_no_difference_between_modes(pupils: PyramidPupils) -> None:
    config, model = configuration(), poked(pupils, 0.05)
    optics, x = model.optics(), model._pupil.coordinates_m
    surfaces = model._surfaces(x)
    m2c = model._basis()
    unit = np.tensordot(m2c.T, surfaces, 1) * 2 * config.devices.dm.stroke_m
    # Modes that need large commands are poked less.
    pokes, wave = random_pokes(model), 2 * np.pi / config.system.wavelength_m
    power = np.square(pokes.modes_rad[:, pokes.lit]).mean(axis=1)
    amplitude = np.sqrt(power / np.square(wave * unit[:, pokes.lit]).mean(axis=1))
    assert np.square(amplitude).sum() == pytest.approx(0.05**2, rel=1e-3)
    commands = amplitude * np.random.default_rng(1).standard_normal((3000, m2c.shape[1]))
    slopes = np.array([
        slopes_of_image(optics.frame(np.tensordot(c, unit, 1).astype(np.float32)), pupils) for c in commands
    ])  # fmt: skip
    seen = np.linalg.lstsq(commands - commands.mean(axis=0), slopes - slopes.mean(axis=0))[0].T
    want, derivatives = model.modal_jacobian(Registration(), m2c)
    gains = np.vdot(seen, want) / np.vdot(want, want), (seen * want).sum(axis=0) / np.square(want).sum(axis=0)
    assert gains[0] == pytest.approx(1.0, abs=0.015)
    assert gains[1].std() < 0.015
    terms = np.concatenate([want[None], derivatives]).reshape(len(derivatives) + 1, -1)
    gain, *moved = np.linalg.lstsq(terms @ terms.T, terms @ seen.ravel())[0]
    assert np.abs(np.array(moved[3:5]) / gain).max() < 0.3


@pytest.mark.parametrize(
    "ratio", [1.5, 14.0, *(pytest.param(ratio, marks=pytest.mark.slow) for ratio in (4.0, 8.0))]
)
def test_the_strength_is_estimated_with_pokes(pupils: PyramidPupils, ratio: float) -> None:
    model = poked(pupils, 0.05)
    optics, pokes = model.optics(), random_pokes(model)
    # Other phases than those that the estimate compares with.
    screens = unit_screens(optics.amplitude.shape[0], 4.0)
    turbulence = np.array([screen.T[::-1] for screen in screens])
    turbulence = np.tile(turbulence * ratio ** (5 / 6), (4, 1, 1))

    def slopes(rng: np.random.Generator) -> NDArray[np.float64]:
        beside = np.tensordot(
            rng.standard_normal((len(turbulence), len(pokes.modes_rad))), pokes.modes_rad, 1
        )
        paths = ((turbulence + beside) * (optics.wavelength_m / (2 * np.pi))).astype(np.float32)
        seen = np.array([slopes_of_image(optics.frame(path), pupils) for path in paths])
        return np.asarray((seen - seen.mean(axis=0)) * np.sqrt(len(seen) / (len(seen) - 1)))

    found = []
    # One estimate beside weak turbulence scatters by 40 %.
    for seed in (5, 6):
        rng = np.random.default_rng(seed)
        first, second = slopes(rng), slopes(rng)
        rms = float(np.sqrt(np.mean(np.square([first, second]))))
        seen = replace(pupils, motion=rms, persistent_fraction=float(np.mean(first * second) / rms**2))
        found.append(estimate_strength(optics, seen, screens, pokes))
    assert np.mean(found) == pytest.approx(ratio, rel=0.3)


def test_pokes_alone_are_no_turbulence(pupils: PyramidPupils) -> None:
    model = poked(replace(pupils, motion=0.4, persistent_fraction=0.0), 0.05, turbulence=None)
    assert model.turbulence == 0


@pytest.mark.slow
def test_the_uncertainty_falls_with_the_states_that_were_averaged(pupils: PyramidPupils) -> None:
    # A strength that is known: its error does not fall.
    config = configuration("sensor.turbulence_sigma=1e-6")
    few = replace(pupils, n_effective=4.0, centre_sigma_px=0.01)
    model = PyramidModel(config, few, turbulence=8.0)
    once = model.registration_systematic_error
    assert (once > 0).all()
    assert 0.5 < once[0] < 30
    assert 0.01 < once[2] < 3
    many = PyramidModel(config, replace(few, n_effective=400.0, centre_sigma_px=0.0), turbulence=8.0)
    assert many.registration_systematic_error[2:3] == pytest.approx(once[2:3] / 10)
    still = PyramidModel(config, replace(pupils, centre_sigma_px=0.01), turbulence=8.0)
    assert still.registration_systematic_error[2] == pytest.approx(0, abs=1e-6)
    assert (many.registration_systematic_error[3:] < once[3:]).all()
    assert still.registration_systematic_error[0] == pytest.approx(1.0, rel=0.1)
