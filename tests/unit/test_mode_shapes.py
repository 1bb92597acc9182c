"""Zernike and Fourier modes as fitted by a mirror."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.modes.bases import fourier, zernike
from escape_hw.errors import CalibrationError
from escape_sim.mirror.influence_functions import InfluenceFunctions

N = 64


@pytest.fixture(scope="module")
def mirror():
    """A fine mirror, so that low modes come out nearly as they should; unit circle, piston aside."""
    at = np.arange(-7, 8) * 0.16
    places = np.array([(x, y) for y in at for x in at if np.hypot(x, y) < 1.25])
    from escape_hw.api.registration import Registration

    x = (np.arange(N) - (N - 1) / 2) / (N / 2)
    surfaces = InfluenceFunctions(places, 0.16, 0.4).surfaces(Registration(), 1.0, x, x)
    return surfaces, np.hypot(*np.meshgrid(x, x)) <= 1


def shapes(m2c, mirror):
    surfaces, pupil = mirror
    made = m2c.T @ surfaces[:, pupil]
    return made - made.mean(axis=1, keepdims=True)


def alike(one, other):
    other = other - other.mean()
    return abs(one @ other) / np.linalg.norm(one) / np.linalg.norm(other)


def test_zernike_modes_come_in_nolls_order(mirror):
    made = shapes(zernike(*mirror, 20), mirror)
    x, y = (np.meshgrid(*2 * [(np.arange(N) - (N - 1) / 2) / (N / 2)])[k][mirror[1]] for k in (0, 1))
    r2 = x**2 + y**2
    # Noll 1976, Table I: j = 2 to 8 and 11.
    table = [x, y, 2 * r2 - 1, 2 * x * y, x**2 - y**2, (3 * r2 - 2) * y, (3 * r2 - 2) * x]
    for mode, want in zip(made, table, strict=False):
        assert alike(mode, want) > 0.999
    assert alike(made[9], 6 * r2**2 - 6 * r2 + 1) > 0.995
    np.testing.assert_allclose(made.std(axis=1), 1.0, rtol=1e-9)


def test_zernike_modes_are_nearly_orthogonal(mirror):
    made = shapes(zernike(*mirror, 20), mirror)
    overlap = np.corrcoef(made) - np.eye(20)
    assert np.abs(overlap).max() < 0.05


def test_fourier_modes_rise_in_frequency(mirror):
    made = shapes(fourier(*mirror, 14), mirror)
    x, y = (np.meshgrid(*2 * [(np.arange(N) - (N - 1) / 2) / (N / 2)])[k][mirror[1]] for k in (0, 1))
    for mode, want in zip(
        made, [x, y, np.cos(np.pi * x), np.sin(np.pi * x), np.cos(np.pi * y), np.sin(np.pi * y)], strict=False
    ):
        assert alike(mode, want) > 0.999
    np.testing.assert_allclose(made.std(axis=1), 1.0, rtol=1e-9)


@pytest.mark.parametrize("make", [zernike, fourier])
def test_more_than_the_mirror_can_make_is_refused(mirror, make):
    surfaces, pupil = mirror
    few = surfaces[::12]
    with pytest.raises(CalibrationError, match=r"cannot make .* modes; lower basis.n_modes"):
        make(few, pupil, len(few))
