"""The registration convention is OOPAO's, with the shifts reversed."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.registration import Registration
from escape_hw.config import layouts
from escape_hw.config.layouts import grid_positions
from escape_sim.mirror.influence_functions import InfluenceFunctions
from escape_sim.mirror.surface import make_mirror_surface
from escape_sim.oopao.library import make_source, mis_registration, oopao_classes, suppress_output

N = 64
N_SUB = 8
PUPIL_M = 6.75e-3
SUB_M = PUPIL_M / N_SUB
COUPLING = 0.4

REGISTRATIONS = [
    Registration(),
    Registration(shift_x=37.0),
    Registration(shift_y=-71.0),
    Registration(rotation=1.7),
    Registration(radial_scaling=4.0),
    Registration(tangential_scaling=-3.0),
    Registration(-16.0, -71.0, -0.77, 2.9, 0.0),
    Registration(95.0, 60.0, -2.0, -4.0, 3.5),
    Registration(-300.0, 250.0, 25.0, 10.0, -8.0),
    Registration(radial_scaling=4.0, anamorphosis_angle=30.0),
    Registration(-16.0, -71.0, -0.77, 2.9, -1.0, -52.0),
    Registration(95.0, 60.0, 12.0, -9.0, 11.0, 45.0),
    Registration(40.0, 0.0, 5.0, 3.0, 3.0, 20.0),
]


@pytest.fixture(scope="module")
def influence() -> InfluenceFunctions:
    pitch = PUPIL_M / 9
    y, x = np.indices((11, 11)) - 5
    return InfluenceFunctions(pitch * grid_positions(x**2 + y**2 <= 29), pitch, COUPLING)


@pytest.fixture(scope="module")
def mirror(influence: InfluenceFunctions):
    light = make_source(np.ones((N, N), np.float32), PUPIL_M, 635e-9)
    with suppress_output():
        return oopao_classes().DeformableMirror(
            telescope=light.telescope,
            nSubap=N_SUB,
            mechCoupling=COUPLING,
            coordinates=influence.positions_m,
            pitch=influence.pitch_m,
            print_dm_properties=False,
        )


@pytest.mark.parametrize("registration", REGISTRATIONS, ids=str)
def test_surfaces_equal_those_of_oopao(influence, mirror, registration):
    # OOPAO lays the mirror's samples from edge to edge of the pupil, both edges included.
    line = np.linspace(-PUPIL_M / 2, PUPIL_M / 2, N)
    ours = influence.surfaces(registration, SUB_M, line, line)
    with suppress_output():
        theirs = mirror.apply_mis_registration(mis_registration(registration, SUB_M))
    theirs = theirs.modes.T.reshape(ours.shape)
    assert ours.max() > 0.9
    assert np.abs(ours - theirs).max() < 1e-9 * theirs.max()


@pytest.mark.parametrize("registration", REGISTRATIONS[6:], ids=str)
def test_rings_equal_those_of_oopao(registration):
    pitch = PUPIL_M / 22
    rings = InfluenceFunctions(layouts.positions("rings-336") * pitch, pitch, 0.3)
    light = make_source(np.ones((48, 48), np.float32), PUPIL_M, 635e-9)
    with suppress_output():
        theirs = oopao_classes().DeformableMirror(
            telescope=light.telescope, nSubap=N_SUB, mechCoupling=0.3, coordinates=rings.positions_m,
            pitch=pitch, print_dm_properties=False, misReg=mis_registration(registration, SUB_M),
        )  # fmt: skip
    line = np.linspace(-PUPIL_M / 2, PUPIL_M / 2, 48)
    ours = rings.surfaces(registration, SUB_M, line, line)
    assert np.abs(ours - theirs.modes.T.reshape(ours.shape)).max() < 1e-9
    command = np.random.default_rng(0).uniform(-1, 1, 336)
    fast = make_mirror_surface(rings, registration, SUB_M, line, line)(command)
    assert np.abs(fast.ravel() - theirs.modes @ command).max() < 1e-5


def test_the_comparison_would_notice_a_reversed_shift(influence, mirror):
    line = np.linspace(-PUPIL_M / 2, PUPIL_M / 2, N)
    ours = influence.surfaces(Registration(shift_x=-5.0), SUB_M, line, line)
    with suppress_output():
        theirs = mirror.apply_mis_registration(mis_registration(Registration(shift_x=5.0), SUB_M))
    assert np.abs(ours - theirs.modes.T.reshape(ours.shape)).max() > 1e-2


def test_positive_shifts_move_the_mirror_to_higher_columns_and_rows(influence):
    line = np.linspace(-PUPIL_M / 2, PUPIL_M / 2, N)
    middle = int(np.argmin(np.hypot(*influence.positions_m.T)))

    def centre(registration: Registration) -> tuple[float, float]:
        surface = influence.surfaces(registration, SUB_M, line, line)[middle]
        return float((surface.sum(0) @ line) / surface.sum()), float((surface.sum(1) @ line) / surface.sum())

    x, y = centre(Registration(shift_x=50.0, shift_y=20.0))
    assert x == pytest.approx(0.5 * SUB_M, rel=1e-3)
    assert y == pytest.approx(0.2 * SUB_M, rel=1e-3)


def test_a_positive_rotation_turns_columns_towards_rows(influence):
    right = int(np.argmax(influence.positions_m[:, 0]))
    before = influence.positions_m[right]
    after = influence.registered_positions(Registration(rotation=2.0), SUB_M)[right]
    turned = np.degrees(np.arctan2(after[1], after[0]) - np.arctan2(before[1], before[0]))
    assert turned == pytest.approx(2.0, abs=1e-9)
