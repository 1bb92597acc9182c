"""Influence functions: shapes, factors, and which way a registration moves them."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.registration import Registration
from escape_sim.influence import InfluenceFunctions, MirrorSurface, layout_positions

PITCH, D = 0.75e-3, 0.28e-3
X = np.linspace(-4e-3, 4e-3, 81)
Y = np.linspace(-3.5e-3, 3.5e-3, 61)
#: A rotation, unequal scalings and shifts at once.
GENERAL = Registration(37.0, -61.0, 1.7, 2.3, -3.1)


def mirror(**options):
    layout = np.ones((5, 7), bool)
    layout[0, 0] = layout[4, 6] = False
    return InfluenceFunctions(layout_positions(layout, PITCH), PITCH, 0.4, **options)


def dense(m, registration):
    """The formula of the class's docstring, actuator by actuator."""
    matrix, offset = registration.affine(D)
    sigma = PITCH / np.sqrt(2 * np.log(1 / m.coupling))
    sx, sy = (sigma * (1 + s / 100) for s in (registration.radial_scaling, registration.tangential_scaling))
    width, gain = (np.broadcast_to(v, (m.n_act,)) for v in (m.width, m.gain))
    out = np.zeros((m.n_act, Y.size, X.size))
    for a, position in enumerate(m.positions_m):
        x, y = matrix @ position + offset
        for share, scale in ((1 - m.wing, 1.0), (m.wing, m.wing_scale)):
            r2 = ((X[None, :] - x) / sx) ** 2 + ((Y[:, None] - y) / sy) ** 2
            out[a] += share * gain[a] * np.exp(-0.5 * r2 / (width[a] * scale) ** 2)
    return out


def rough(n):
    rng = np.random.default_rng(0)
    return {
        "width": 1 + 0.1 * rng.standard_normal(n),
        "gain": 1 + 0.1 * rng.standard_normal(n),
        "wing": 0.15,
        "wing_scale": 2.5,
    }


@pytest.mark.parametrize("registration", [Registration(), GENERAL])
@pytest.mark.parametrize("options", [{}, rough(33)], ids=["plain", "with scatter and wings"])
def test_separable_factors_make_the_dense_formula(registration, options):
    m = mirror(**options)
    want = dense(m, registration)
    assert np.abs(m.surfaces(registration, D, X, Y) - want).max() < 1e-14
    rng = np.random.default_rng(1)
    command = rng.uniform(-1, 1, m.n_act)
    fast = MirrorSurface(m, registration, D, X, Y)(command)
    assert fast.dtype == np.float32
    assert np.abs(fast - np.tensordot(command, want, 1)).max() < 2e-6


def test_positions_are_row_major_and_centred():
    at = mirror().positions_m
    assert at.shape == (33, 2)
    # Actuator (0, 1) comes first, (0, 2) next: x grows along columns, y along rows.
    assert at[0] == pytest.approx([-2 * PITCH, -2 * PITCH])
    assert at[1] == pytest.approx([-1 * PITCH, -2 * PITCH])
    assert at[6] == pytest.approx([-3 * PITCH, -1 * PITCH])
    assert layout_positions(np.ones((4, 6), bool), 1.0).mean(axis=0) == pytest.approx([0, 0])


def test_coupling_is_the_height_one_pitch_away():
    m = InfluenceFunctions(np.zeros((1, 2)), PITCH, 0.37)
    surface = m.surfaces(Registration(), D, np.array([-PITCH, 0.0, PITCH]), np.array([0.0, PITCH]))[0]
    assert surface[0] == pytest.approx([0.37, 1.0, 0.37])
    assert surface[1, 1] == pytest.approx(0.37)


def centroid(surface):
    total = surface.sum()
    return float((surface * X[None, :]).sum() / total), float((surface * Y[:, None]).sum() / total)


def moved(registration, at=(0.0, 0.0)):
    m = InfluenceFunctions(np.array([at]), PITCH, 0.3)
    return centroid(m.surfaces(registration, D, X, Y)[0])


def test_positive_shifts_move_to_higher_columns_and_rows():
    assert moved(Registration(shift_x=150.0)) == pytest.approx((1.5 * D, 0.0), abs=1e-7)
    assert moved(Registration(shift_y=150.0)) == pytest.approx((0.0, 1.5 * D), abs=1e-7)


def test_a_positive_rotation_turns_x_towards_y():
    x, y = moved(Registration(rotation=30.0), (1e-3, 0.0))
    assert (x, y) == pytest.approx((1e-3 * np.cos(np.pi / 6), 1e-3 * np.sin(np.pi / 6)), abs=1e-7)


def test_scalings_stretch_positions_and_widths():
    assert moved(Registration(radial_scaling=10.0), (1e-3, 1e-3)) == pytest.approx((1.1e-3, 1e-3), abs=1e-7)
    assert moved(Registration(tangential_scaling=10.0), (1e-3, 1e-3)) == pytest.approx(
        (1e-3, 1.1e-3), abs=1e-7
    )
    m = InfluenceFunctions(np.zeros((1, 2)), PITCH, 0.4)
    here = m.surfaces(Registration(radial_scaling=10.0), D, np.array([1.1 * PITCH]), np.array([PITCH]))
    assert here[0, 0, 0] == pytest.approx(0.4 * 0.4)


def test_scaling_comes_before_rotation():
    registration = Registration(rotation=90.0, radial_scaling=20.0)
    assert moved(registration, (1e-3, 0.0)) == pytest.approx((0.0, 1.2e-3), abs=1e-7)
    assert moved(registration, (0.0, 1e-3)) == pytest.approx((-1e-3, 0.0), abs=1e-7)
