"""Modal bases: orthonormal, uncorrelated under turbulence, and the same every time."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from scipy import integrate, special

from escape_hw.api.registration import Registration
from escape_hw.calibration.modes.bases import (
    fix_signs,
    karhunen_loeve,
    scale_to_unit_rms,
    von_karman_covariance,
    zonal,
)
from escape_hw.config.layouts import grid_positions
from escape_hw.errors import CalibrationError
from escape_sim.mirror.influence_functions import InfluenceFunctions

DIAMETER = 6.75e-3
N = 40
PIXEL = DIAMETER / N
OUTER_SCALE = 4 * DIAMETER


@pytest.fixture(scope="module")
def mirror():
    line = np.arange(9) - 4
    layout = line[:, None] ** 2 + line**2 <= 20
    pitch = DIAMETER / 7
    influence = InfluenceFunctions(pitch * grid_positions(layout), pitch, 0.4)
    x = (np.arange(N) - (N - 1) / 2) * PIXEL
    pupil = np.hypot(x[:, None], x) <= DIAMETER / 2
    return influence.surfaces(Registration(), DIAMETER / 24, x, x), pupil


def surfaces_of(m2c, mirror):
    """Surfaces of the modes over the pupil ``(n_modes, n_pixels)``, less their piston."""
    surfaces, pupil = mirror
    modes = m2c.T @ surfaces[:, pupil]
    return modes - modes.mean(axis=1, keepdims=True)


@pytest.fixture(scope="module")
def modes(mirror):
    return karhunen_loeve(*mirror, PIXEL, 60, OUTER_SCALE)


def test_modes_are_orthonormal_over_the_pupil(modes, mirror):
    shapes = surfaces_of(modes, mirror)
    assert shapes @ shapes.T / shapes.shape[1] == pytest.approx(np.eye(60), abs=1e-9)


def test_no_mode_is_piston(modes, mirror):
    # Pure piston would have no rms left, hence a huge command.
    surfaces, pupil = mirror
    piston = np.linalg.lstsq(surfaces[:, pupil].T, np.ones(int(pupil.sum())), rcond=None)[0]
    made = (piston @ surfaces[:, pupil]).std()
    assert made < 0.01
    # Scaled to the size of the modes it would take a command two orders of magnitude larger.
    assert np.linalg.norm(piston) / made > 3 * np.linalg.norm(modes, axis=0).max()


def test_coefficients_under_turbulence_are_uncorrelated(modes, mirror):
    shapes = surfaces_of(modes, mirror)
    rows, columns = np.nonzero(mirror[1])
    apart = np.hypot(rows[:, None] - rows, columns[:, None] - columns) * PIXEL
    # The covariance by direct sums over all pairs of pixels; the basis went through Fourier space.
    covariance = shapes @ von_karman_covariance(apart, OUTER_SCALE) @ shapes.T
    variance = np.diag(covariance)
    correlation = covariance / np.sqrt(np.outer(variance, variance)) - np.eye(60)
    # The hair of anisotropy that tells pairs of equal modes apart leaves this much.
    assert np.abs(correlation).max() < 5e-4
    assert (np.diff(variance) < 1e-4 * variance[:-1]).all()
    # Tip and tilt carry most.
    assert variance[:2].sum() > 0.6 * variance.sum()


def test_covariance_is_the_fourier_transform_of_the_spectrum():
    def by_integration(r):
        def integrand(f):
            return f * (f**2 + 1) ** (-11 / 6) * special.j0(2 * np.pi * f * r)

        # Geometric panels, none longer than a turn of the Bessel function.
        edges = [0.0]
        while edges[-1] < 400:
            edges.append(edges[-1] + min(0.1 + 0.5 * edges[-1], 0.5 / max(r, 1e-3)))
        return sum(integrate.fixed_quad(integrand, a, b, n=24)[0] for a, b in pairwise(edges))

    r = np.array([0.0, 0.05, 0.2, 0.5, 1.5])
    want = np.array([by_integration(v) for v in r])
    assert von_karman_covariance(r, 1.0) == pytest.approx(
        want / 0.6, abs=3e-4
    )  # the integral at r = 0 is 3 / 5
    assert von_karman_covariance(3 * r, 3.0) == pytest.approx(von_karman_covariance(r, 1.0))


def test_rounding_changes_nothing(modes, mirror):
    # The mirror is symmetric: tip and tilt, and many pairs above them, have equal variances.
    surfaces, pupil = mirror
    noise = np.random.default_rng(2).standard_normal(surfaces.shape)
    again = karhunen_loeve(surfaces * (1 + 1e-14 * noise), pupil, PIXEL, 60, OUTER_SCALE)
    assert np.abs(again - modes).max() < 1e-6 * np.abs(modes).max()


def test_a_cut_between_equal_modes_is_always_the_same(mirror):
    surfaces, pupil = mirror
    noise = np.random.default_rng(3).standard_normal(surfaces.shape)
    for n_modes in range(30, 60):
        once, again = (
            karhunen_loeve(s, pupil, PIXEL, n_modes, OUTER_SCALE)
            for s in (surfaces, surfaces * (1 + 1e-14 * noise))
        )
        assert np.abs(again - once).max() < 1e-6 * np.abs(once).max()


def test_tip_and_tilt_come_first_along_the_axes(modes, mirror):
    rows, columns = np.nonzero(mirror[1])
    shapes = surfaces_of(modes, mirror)[:2]
    lines = np.stack([v - v.mean() for v in (columns, rows)])
    lines /= lines.std(axis=1, keepdims=True)
    overlap = np.sort(np.abs(shapes @ lines.T / rows.size), axis=1)
    assert (overlap[:, 0] < 1e-6).all()
    assert (overlap[:, 1] > 0.99).all()


def test_signs_are_fixed(modes, mirror):
    rng = np.random.default_rng(0)
    flipped = modes * rng.choice([-1, 1], 60)
    assert np.array_equal(fix_signs(flipped), modes)
    nearly_largest = np.abs(modes) >= np.abs(modes).max(axis=0) * (1 - 1e-6)
    assert (modes[nearly_largest.argmax(axis=0), np.arange(60)] > 0).all()


def test_a_tie_goes_to_the_first_actuator():
    # Equal but for rounding, as in a mode that is odd about the mirror's axis.
    pair = np.array([[-0.5, 0.5], [0.1, 0.2], [0.5 + 1e-12, -0.5 - 1e-12]])
    assert fix_signs(pair)[0] == pytest.approx([0.5, 0.5])


def test_fewer_modes_reach_the_same_low_orders(modes, mirror):
    few = surfaces_of(karhunen_loeve(*mirror, PIXEL, 40, OUTER_SCALE), mirror)
    many = surfaces_of(modes, mirror)
    # Tip and tilt may turn within their plane, but the plane stays.
    overlap = np.linalg.svd(few[:2] @ many[:2].T / many.shape[1])[1]
    assert overlap.min() > 0.999


def test_too_many_modes_are_an_error(mirror):
    n_act = mirror[0].shape[0]
    karhunen_loeve(*mirror, PIXEL, n_act - 1, OUTER_SCALE)
    with pytest.raises(CalibrationError, match=rf"{n_act} modes requested.*at most {n_act - 1}"):
        karhunen_loeve(*mirror, PIXEL, n_act, OUTER_SCALE)
    with pytest.raises(CalibrationError, match=f"has {n_act} actuators"):
        zonal(*mirror, n_act + 1)


def test_actuators_without_effect_reduce_the_number_of_modes(mirror):
    surfaces, pupil = mirror
    dead = surfaces.copy()
    dead[:5] = 0.0
    with pytest.raises(CalibrationError, match="at most"):
        karhunen_loeve(dead, pupil, PIXEL, surfaces.shape[0] - 2, OUTER_SCALE)


def test_zonal_modes_move_one_actuator_each(mirror):
    m2c = zonal(*mirror, 12)
    assert m2c.shape == (mirror[0].shape[0], 12)
    assert (np.count_nonzero(m2c, axis=0) == 1).all()
    assert surfaces_of(m2c, mirror).std(axis=1) == pytest.approx(np.ones(12))


def test_unit_rms_scales_and_nothing_else(mirror):
    m2c = np.random.default_rng(1).normal(size=(mirror[0].shape[0], 5))
    scaled = scale_to_unit_rms(m2c, *mirror)
    assert surfaces_of(scaled, mirror).std(axis=1) == pytest.approx(np.ones(5))
    assert scaled / m2c == pytest.approx(np.broadcast_to((scaled / m2c)[0], m2c.shape))
