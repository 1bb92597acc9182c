"""Widths and encircled energy of images with known formulas: Gaussian and Airy pattern."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import special

from escape_hw.errors import CalibrationError
from escape_hw.pipeline.psf.shape import encircled_energy, measure_psf_shape

#: Full width at half maximum of a Gaussian in standard deviations, and of an Airy pattern in lambda/D.
GAUSSIAN, AIRY = 2 * np.sqrt(2 * np.log(2)), 1.02899


def gaussian(
    sigma: tuple[float, float], angle_deg: float = 0.0, centre: tuple[float, float] = (31.3, 33.7)
) -> NDArray[np.float64]:
    """An elliptical Gaussian of unit sum on 64 x 64 pixels; the first width is along the angle."""
    y, x = np.indices((64, 64)) - np.array(centre)[:, None, None]
    a = np.radians(angle_deg)
    along, across = x * np.cos(a) + y * np.sin(a), -x * np.sin(a) + y * np.cos(a)
    body = np.exp(-0.5 * ((along / sigma[0]) ** 2 + (across / sigma[1]) ** 2))
    return body / (2 * np.pi * sigma[0] * sigma[1])


def airy(psf_px: float, size: int = 128, fine: int = 4) -> NDArray[np.float64]:
    """An Airy pattern of unit flux over an infinite camera, integrated over the pixels."""
    offset = (np.arange(fine) - (fine - 1) / 2) / fine
    place = (np.arange(size)[:, None] + offset - size // 2).ravel() / psf_px
    u = np.pi * np.hypot(place[:, None], place) + 1e-12
    body = (2 * special.j1(u) / u) ** 2 * np.pi / 4 / psf_px**2
    return body.reshape(size, fine, size, fine).mean(axis=(1, 3))


@pytest.mark.parametrize("sigma", [1.2, 2.5, 5.0])
def test_gaussian(sigma: float) -> None:
    shape = measure_psf_shape(1e5 * gaussian((sigma, sigma)) + 100)
    assert (shape.row, shape.column) == pytest.approx((31.3, 33.7), abs=0.05)
    for width in (shape.fwhm, shape.major, shape.minor):
        assert width == pytest.approx(GAUSSIAN * sigma, rel=0.015)
    # The share within r is 1 - exp(-r^2 / (2 s^2)); a pixel spreads its light evenly over its area.
    s = np.sqrt(sigma**2 + 1 / 12)
    assert shape.r50 == pytest.approx(s * np.sqrt(2 * np.log(2)), rel=0.015)
    assert shape.r80 == pytest.approx(s * np.sqrt(2 * np.log(5)), rel=0.015)
    assert shape.flux == pytest.approx(1e5, rel=0.01)


@pytest.mark.parametrize("angle", [0.0, 35.0, -70.0])
def test_longest_and_shortest_diameter_of_an_elongated_image(angle: float) -> None:
    shape = measure_psf_shape(gaussian((3.0, 2.4), angle))
    assert shape.major == pytest.approx(3.0 * GAUSSIAN, rel=0.02)
    assert shape.minor == pytest.approx(2.4 * GAUSSIAN, rel=0.02)
    assert shape.angle_deg == pytest.approx(angle, abs=2)


def test_airy_pattern() -> None:
    image = airy(psf_px=10.0)
    shape = measure_psf_shape(image)
    assert shape.fwhm == pytest.approx(AIRY * 10.0, rel=0.01)
    radii, shares = encircled_energy(image, (64, 64))
    near = (radii > 1) & (radii < 40)
    # Born & Wolf, section 8.5.2.
    u = np.pi * radii[near] / 10.0
    # Part of the light of the whole pattern, which has unit sum, falls beside the image.
    assert shares[near] * image.sum() == pytest.approx(1 - special.j0(u) ** 2 - special.j1(u) ** 2, abs=0.006)


def test_noise_does_not_bias_the_width() -> None:
    rng = np.random.default_rng(3)
    images = [rng.poisson(40_000 * gaussian((2.5, 2.5)) + 10.0) for _ in range(20)]
    widths = [measure_psf_shape(one).fwhm for one in images]
    assert np.mean(widths) == pytest.approx(GAUSSIAN * 2.5, rel=0.02)
    assert np.std(widths) < 0.1 * GAUSSIAN * 2.5


def test_no_light_and_a_peak_at_the_edge_are_refused() -> None:
    rng = np.random.default_rng(1)
    with pytest.raises(CalibrationError, match="no light"):
        measure_psf_shape(rng.normal(100, 3, (64, 64)))
    with pytest.raises(CalibrationError, match="edge"):
        measure_psf_shape(gaussian((2.0, 2.0), centre=(0.0, 30.0)))
