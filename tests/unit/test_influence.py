"""Influence functions: shapes, factors, and which way a registration moves them."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.registration import Registration
from escape_hw.config.layouts import grid_positions
from escape_sim.mirror.influence_functions import (
    InfluenceFunctions,
    exponential_length,
    exponential_profile,
)
from escape_sim.mirror.measured import MeasuredInfluenceFunctions
from escape_sim.mirror.mode_surfaces import gaussian_factors
from escape_sim.mirror.surface import DenseSurface, GriddedSurface, WindowedSurface, make_mirror_surface

PITCH, D = 0.75e-3, 0.28e-3
X = np.linspace(-4e-3, 4e-3, 81)
Y = np.linspace(-3.5e-3, 3.5e-3, 61)
#: A rotation, unequal scalings and shifts at once.
GENERAL = Registration(37.0, -61.0, 1.7, 2.3, -3.1)
ANAMORPHIC = Registration(37.0, -61.0, 1.7, 5.3, -3.1, 33.0)


def mirror(**options):
    layout = np.ones((5, 7), bool)
    layout[0, 0] = layout[4, 6] = False
    return InfluenceFunctions(PITCH * grid_positions(layout), PITCH, 0.4, **options)


def dense(m, registration):
    """The formula of the class's docstring, actuator by actuator."""
    matrix, offset = registration.affine(D)
    sigma = PITCH / np.sqrt(2 * np.log(1 / m.coupling))
    sx, sy = (sigma * (1 + s / 100) for s in (registration.radial_scaling, registration.tangential_scaling))
    width, gain = (np.broadcast_to(v, (m.n_act,)) for v in (m.width, m.gain))
    out = np.zeros((m.n_act, Y.size, X.size))
    for a, position in enumerate(m.positions_m):
        x, y = matrix @ position + offset
        for share, scale in m.profile:
            # Along the radial direction, which lies at minus the anamorphosis angle, and across it.
            c, s = (f(np.deg2rad(registration.anamorphosis_angle)) for f in (np.cos, np.sin))
            dx, dy = X[None, :] - x, Y[:, None] - y
            r2 = ((c * dx - s * dy) / sx) ** 2 + ((s * dx + c * dy) / sy) ** 2
            out[a] += share * gain[a] * np.exp(-0.5 * r2 / (width[a] * scale) ** 2)
    return out


def rough(n):
    rng = np.random.default_rng(0)
    return {
        "width": 1 + 0.1 * rng.standard_normal(n),
        "gain": 1 + 0.1 * rng.standard_normal(n),
        "profile": ((0.85, 1.0), (0.15, 2.5)),
    }


@pytest.mark.parametrize("registration", [Registration(), GENERAL, ANAMORPHIC])
@pytest.mark.parametrize("options", [{}, rough(33)], ids=["plain", "with scatter and two Gaussians"])
def test_separable_factors_make_the_dense_formula(registration, options):
    m = mirror(**options)
    want = dense(m, registration)
    # Zero where a Gaussian is below 1e-12.
    assert np.abs(m.surfaces(registration, D, X, Y) - want).max() < 1.5e-12
    rng = np.random.default_rng(1)
    command = rng.uniform(-1, 1, m.n_act)
    factors = m.factors(registration, D, X, Y)
    for fast in (DenseSurface(*factors), WindowedSurface(*factors), GriddedSurface(want)):
        surface = fast(command)
        assert surface.dtype == np.float32
        assert np.abs(surface - np.tensordot(command, want, 1)).max() < 4e-6


def test_positions_are_row_major_and_centred():
    at = mirror().positions_m
    assert at.shape == (33, 2)
    # Actuator (0, 1) comes first, (0, 2) next: x grows along columns, y along rows.
    assert at[0] == pytest.approx([-2 * PITCH, -2 * PITCH])
    assert at[1] == pytest.approx([-1 * PITCH, -2 * PITCH])
    assert at[6] == pytest.approx([-3 * PITCH, -1 * PITCH])
    assert grid_positions(np.ones((4, 6), bool)).mean(axis=0) == pytest.approx([0, 0])


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


def test_the_anamorphosis_angle_turns_the_axes_of_the_scalings():
    turned = Registration(radial_scaling=10.0, tangential_scaling=-10.0, anamorphosis_angle=90.0)
    swapped = Registration(radial_scaling=-10.0, tangential_scaling=10.0)
    m = mirror()
    assert m.surfaces(turned, D, X, Y) == pytest.approx(m.surfaces(swapped, D, X, Y), abs=1e-12)
    # At 30 degrees the radial axis points towards -y.
    at = moved(Registration(radial_scaling=10.0, anamorphosis_angle=30.0), (1e-3, -1e-3 * np.tan(np.pi / 6)))
    assert at == pytest.approx((1.1e-3, -1.1e-3 * np.tan(np.pi / 6)), abs=1e-7)


def test_scalings_alike_need_no_angle():
    plain, turned = (
        Registration(radial_scaling=4.0, tangential_scaling=4.0, anamorphosis_angle=a) for a in (0, 50)
    )
    m = mirror()
    assert m.factors(turned, D, X, Y)[0].shape[2] == 1
    assert m.surfaces(turned, D, X, Y) == pytest.approx(m.surfaces(plain, D, X, Y), abs=1e-12)


def test_the_faster_way_is_taken():
    few = make_mirror_surface(mirror(), Registration(), D, X, Y)
    assert isinstance(few, DenseSurface)
    line = np.linspace(-1, 1, 120)
    many = InfluenceFunctions(grid_positions(np.ones((30, 30), bool)) * 2 / 30, 2 / 30, 0.3)
    fast = make_mirror_surface(many, Registration(rotation=3.0), 0.1, line, line)
    assert isinstance(fast, WindowedSurface)
    command = np.random.default_rng(3).uniform(-1, 1, 900)
    command[5] = 0.0
    want = np.tensordot(command, many.surfaces(Registration(rotation=3.0), 0.1, line, line), 1)
    assert np.abs(fast(command) - want).max() < 1e-5


FINE = 0.1e-3
GRID = (np.arange(121) - 60) * FINE


def measured(**options):
    """What an interferometer would see of the Gaussian mirror, on a grid of its own."""
    return MeasuredInfluenceFunctions(mirror().surfaces(Registration(), D, GRID, GRID), FINE, **options)


@pytest.mark.parametrize(
    "registration",
    [
        Registration(),
        Registration(37.0, -61.0),
        Registration(radial_scaling=4.0, tangential_scaling=-2.0),
        Registration(20.0, 0.0, 0.0, 4.0, -2.0, 25.0),
    ],
    ids=str,
)
def test_measured_shapes_follow_a_registration_as_gaussians_do(registration):
    found = measured().surfaces(registration, D, X, Y)
    want = mirror().surfaces(registration, D, X, Y)
    assert found.shape == want.shape
    assert np.abs(found - want).max() < 2e-5


def test_measured_shapes_turn_with_the_mirror():
    # An ellipse along x, turned by a right angle, lies along y.
    wide = np.exp(-((GRID[None, :] / 1e-3) ** 2) - (GRID[:, None] / 0.5e-3) ** 2)[None]
    turned = MeasuredInfluenceFunctions(wide, FINE).surfaces(Registration(rotation=90.0), D, GRID, GRID)
    assert turned[0] == pytest.approx(wide[0].T, abs=1e-9)


def test_measured_shapes_carry_gains_and_end_where_nothing_was_measured():
    found = measured(gain=np.full(33, 2.0)).surfaces(Registration(), D, GRID, GRID)
    assert found == pytest.approx(2 * mirror().surfaces(Registration(), D, GRID, GRID), abs=1e-6)
    beyond = np.array([6.6e-3, 9e-3])
    assert not measured().surfaces(Registration(), D, beyond, GRID).any()
    fast = make_mirror_surface(measured(), GENERAL, D, X, Y)
    assert isinstance(fast, GriddedSurface)
    command = np.random.default_rng(2).uniform(-1, 1, 33)
    want = np.tensordot(command, measured().surfaces(GENERAL, D, X, Y), 1)
    assert np.abs(fast(command) - want).max() < 5e-6


@pytest.mark.parametrize("cube", [np.zeros((3, 4)), np.full((2, 4, 4), np.nan)])
def test_what_is_no_stack_of_surfaces_is_refused(cube):
    with pytest.raises(ValueError, match="influence functions"):
        MeasuredInfluenceFunctions(cube, FINE)


@pytest.mark.parametrize("rounding", [0.18, 0.27, 0.35])
@pytest.mark.parametrize("coupling", [0.3, 0.42, 0.5])
def test_a_sum_of_gaussians_approximates_a_rounded_exponential(coupling, rounding):
    r = np.linspace(0, 4, 801)
    length = exponential_length(coupling, rounding)
    exact = np.exp(-(np.hypot(r, rounding) - rounding) / length)
    assert exact[200] == pytest.approx(coupling)
    sigma = 1 / np.sqrt(2 * np.log(1 / coupling))
    profile = exponential_profile(coupling, rounding)
    found = sum(share * np.exp(-0.5 * (r / (sigma * width)) ** 2) for share, width in profile)
    slope, error = np.gradient(exact, r), np.gradient(found - exact, r)
    assert np.sqrt(np.sum(r * error**2) / np.sum(r * slope**2)) < 0.06


@pytest.mark.parametrize("registration", [Registration(), GENERAL, ANAMORPHIC], ids=str)
def test_derivatives_of_measured_shapes(registration):
    shapes = MeasuredInfluenceFunctions(
        mirror().surfaces(Registration(), D, GRID, GRID), FINE, positions_m=mirror().positions_m
    ).with_width(1.1)
    parts = shapes.jacobian(registration, D, X, Y, slice(3, 9), float)
    assert parts[0] == pytest.approx(np.moveaxis(shapes.surfaces(registration, D, X, Y)[3:9], 0, 2))
    point = np.append(registration.to_array(), 1.1)
    for k, step in enumerate(np.diag([0.1, 0.1, 0.01, 0.01, 0.01, 1e-3])):
        above, below = (
            shapes.with_width(p[5]).surfaces(Registration(*p[:5], registration.anamorphosis_angle), D, X, Y)[
                3:9
            ]
            for p in (point + step, point - step)
        )
        numeric = np.moveaxis(above - below, 0, 2) / (2 * step.sum())
        assert np.abs(parts[1 + k] - numeric).max() < 1e-3 * np.abs(numeric).max()


def test_a_width_stretches_measured_shapes_about_their_actuators():
    shapes = MeasuredInfluenceFunctions(
        mirror().surfaces(Registration(), D, GRID, GRID), FINE, positions_m=mirror().positions_m
    )
    found = shapes.with_width(1.2).surfaces(GENERAL, D, X, Y)
    assert np.abs(found - mirror(width=1.2).surfaces(GENERAL, D, X, Y)).max() < 2e-3


def test_hardly_any_factors_have_subnormal_products():
    """They make matrix products many times slower on some processors."""
    x = np.linspace(-20e-3, 20e-3, 401)
    factors = gaussian_factors(mirror(profile=((0.85, 1.0), (0.15, 2.5))), Registration(), D, x, x)
    for along_y, along_x in ((0, 0), (1, 0), (0, 2)):
        product = np.abs(factors.along_y[along_y][:, None] * factors.along_x[along_x])
        subnormal = (product > 0) & (product < np.finfo(np.float32).tiny)
        # A derivative vanishes at the actuator itself.
        assert subnormal.mean() < 1e-4
