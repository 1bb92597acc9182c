"""Strehl ratios of aberrations whose Strehl ratio is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from sensor_frames import WAVELENGTH, pupil_amplitude

from escape_hw.api.camera import Frame
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.psf.strehl import (
    centre_image,
    compute_encircled_energy,
    find_peak,
    is_peak_saturated,
    strehl,
    strehl_ratios,
)
from escape_sim.optics.focal_plane import FocalPlane

N = 96
PSF_PX = 2.46
SHAPE = (128, 128)
AMPLITUDE = pupil_amplitude(N, 1.48)


@pytest.fixture(scope="module")
def plane() -> FocalPlane:
    return FocalPlane(AMPLITUDE, N, WAVELENGTH, PSF_PX, SHAPE)


@pytest.fixture(scope="module")
def model(plane) -> NDArray[np.float32]:
    return plane.image(np.zeros((N, N), np.float32))


def aberration(sigma: float, seed: int, lowest: float = 0.0, highest: float = 6.0) -> NDArray[np.float32]:
    """Random path with ``sigma`` rad rms over the beam, between two frequencies in cycles per pupil."""
    rng = np.random.default_rng(seed)
    f = np.fft.fftfreq(2 * N, 1 / (2 * N)) / 2
    r = np.hypot(f[:, None], f)
    white = np.fft.fft2(rng.standard_normal((2 * N, 2 * N)))
    opd = np.fft.ifft2(white * ((r >= lowest) & (r <= highest))).real[:N, :N]
    weight = np.square(AMPLITUDE, dtype=float)
    line = np.arange(N) - (N - 1) / 2
    x, y = np.meshgrid(line, line)
    # Piston does not count, and tip and tilt only move the image.
    basis = np.stack([np.ones((N, N)), x, y])
    gram = np.einsum("iab,jab,ab->ij", basis, basis, weight)
    opd -= np.tensordot(np.linalg.solve(gram, np.einsum("iab,ab,ab->i", basis, opd, weight)), basis, 1)
    rms = np.sqrt((weight * opd**2).sum() / weight.sum())
    return np.asarray(opd * (sigma / rms) * WAVELENGTH / (2 * np.pi), dtype=np.float32)


def tilt(x_px: float, y_px: float) -> NDArray[np.float64]:
    line = (np.arange(N) - (N - 1) / 2) / N * WAVELENGTH / PSF_PX
    return x_px * line[None, :] + y_px * line[:, None]


def test_a_perfect_image_has_strehl_one(model):
    assert strehl_ratios(model, model) == pytest.approx(np.ones(3), abs=1e-12)


@pytest.mark.parametrize("sigma", [0.1, 0.2, 0.3])
def test_small_aberrations_follow_marechal(plane, model, sigma):
    # Averaged over realisations: exp(-sigma^2) is exact only for Gaussian phase.
    found = np.mean([strehl_ratios(plane.image(aberration(sigma, seed)), model) for seed in range(8)], axis=0)
    assert found[:2] == pytest.approx(np.full(2, np.exp(-(sigma**2))), abs=0.1 * sigma**2 + 1e-3)


@pytest.mark.parametrize("sigma", [0.2, 0.5, 1.0, 1.5])
def test_defocus_of_a_round_pupil_follows_its_exact_formula(sigma):
    # phi = sqrt(3) sigma (2 rho^2 - 1) integrates to sin(a) / a with a = sqrt(3) sigma (Born & Wolf 9.1).
    n = 192
    plane = FocalPlane(pupil_amplitude(n), n, WAVELENGTH, 6.0, (160, 160))
    line = (np.arange(n) - (n - 1) / 2) / (n / 2)
    a = np.sqrt(3) * sigma
    opd = a * (2 * (line[:, None] ** 2 + line[None, :] ** 2) - 1) * WAVELENGTH / (2 * np.pi)
    still, blurred = plane.image(np.zeros((n, n), np.float32)), plane.image(opd.astype(np.float32))
    middle = (80, 80)
    assert blurred[middle] / still[middle] == pytest.approx((np.sin(a) / a) ** 2, rel=0.02)
    if sigma < 1:
        # Where the brightest spot still is the middle, the estimators find it there.
        peak, otf, _ = strehl_ratios(blurred, still)
        assert peak == pytest.approx((np.sin(a) / a) ** 2, rel=0.03)
        assert otf == pytest.approx((np.sin(a) / a) ** 2, rel=0.03)


def test_a_cut_off_peak_is_noticed_and_a_hot_pixel_is_not(plane):
    counts = np.minimum(plane.image(np.zeros((N, N), np.float32)) * 1e6, 1e9)
    counts = counts / counts.max() * 3000 + 10
    good = counts.astype(np.uint16)
    assert not is_peak_saturated(Frame(good, 0, 0, 0, 0))
    hot = good.copy()
    hot[5, 9] = 4095
    assert not is_peak_saturated(Frame(hot, 0, 0, 0, 1))
    cut = np.minimum(good, 1500)
    saturated = int((cut == 1500).sum())
    assert saturated > 1
    assert is_peak_saturated(Frame(cut, 0, 0, 0, saturated))
    # That is why: half of the peak gone is half of the first ratio gone.
    assert strehl_ratios(cut.astype(float), good.astype(float))[0] < 0.7


def test_all_three_agree_when_the_light_goes_far_away(plane, model):
    # Ripples of more than three cycles per pupil scatter light beyond the encircled energy's rim.
    images = [plane.image(aberration(0.3, seed, lowest=3.0, highest=12.0)) for seed in range(8)]
    found = np.mean([strehl_ratios(image, model) for image in images], axis=0)
    assert found == pytest.approx(np.full(3, np.exp(-0.09)), abs=0.015)


def test_encircled_energy_keeps_what_stays_close(plane, model):
    # Low orders move light by a pixel or two: the peak falls, the energy within three hardly does.
    peak, _, energy = strehl_ratios(plane.image(aberration(0.4, 1, highest=1.5)), model)
    assert peak < energy < 1


@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.5, 0.5), (0.31, -0.77), (-7.2, 4.6), (15.5, -20.25)])
def test_shifts_do_not_matter(plane, model, shift):
    opd = aberration(0.3, 2)
    still = strehl_ratios(plane.image(opd), model)
    moved = strehl_ratios(plane.image((opd + tilt(*shift)).astype(np.float32)), model)
    # Up to the faint wings that leave the region.
    assert moved == pytest.approx(still, abs=5e-3)


def test_scale_and_background_do_not_matter(plane, model):
    image = plane.image(aberration(0.3, 3))
    want = strehl_ratios(image, model)
    assert strehl_ratios(5e4 * image + 137.0, 2e3 * model + 12.0) == pytest.approx(want, abs=1e-3)


def test_the_image_is_centred(plane):
    image = plane.image(tilt(3.3, -6.6).astype(np.float32))
    assert np.unravel_index(np.argmax(image), SHAPE) == (64 - 7, 64 + 3)  # row, column
    moved = centre_image(image)
    assert moved.sum() == pytest.approx(1, rel=1e-6)
    assert find_peak(moved) == pytest.approx((64, 64), abs=0.02)


def test_encircled_energy_of_a_uniform_image_is_the_circles_area():
    image = np.full((41, 41), 1.0)
    for radius in (3.0, 5.5, 9.0):
        assert compute_encircled_energy(image, radius) == pytest.approx(np.pi * radius**2, rel=0.02)


def test_encircled_energy_of_an_airy_pattern():
    # Within the first minimum of an evenly lit round pupil: 83.8 % (Born & Wolf).
    airy = FocalPlane(pupil_amplitude(192), 192, WAVELENGTH, 10.0, (400, 400)).image(
        np.zeros((192, 192), np.float32)
    )
    assert compute_encircled_energy(airy.astype(float), 12.2) == pytest.approx(0.838, abs=0.004)


def frames(plane, n: int, seed: int, noise: float = 0.0) -> NDArray[np.float64]:
    rng = np.random.default_rng(seed)
    stack = [plane.image(aberration(s, 100 * seed + k)) for k, s in enumerate(rng.uniform(0.1, 0.6, n))]
    images = np.array(stack) * (1000 / np.max(stack[0]))
    return np.asarray(images + rng.normal(0, noise, images.shape))


def test_the_value_is_that_of_the_mean_frame(plane, model):
    stack = frames(plane, 20, 1)
    found = strehl(stack, model)
    assert [found.peak.value, found.otf.value, found.encircled.value] == pytest.approx(
        strehl_ratios(stack.mean(axis=0), model)
    )


def test_errors_shrink_with_the_root_of_the_number_of_frames(plane, model):
    few = [strehl(frames(plane, 16, seed), model).peak.sigma for seed in range(4)]
    many = [strehl(frames(plane, 100, seed), model).peak.sigma for seed in range(4, 6)]
    assert 1.5 < np.mean(few) / np.mean(many) < 4.2


def test_errors_are_correct(model):
    # Frames of the model whose peaks scatter by a known amount.
    found, small = [], model[40:88, 40:88]
    for seed in range(60):
        rng = np.random.default_rng(seed)
        noisy = 1000 * small / small.max() + rng.normal(0, 5.0, (50, *small.shape))
        value = strehl(noisy, small).peak
        found.append((value.value - 1) / value.sigma)
    # The noise here is mostly that of the background, whose median is noisier than its mean by pi / 2 in
    # variance; sixty values know their variance to 18 %.
    assert 0.7 < np.var(found) < 2.4


def test_one_frame_has_no_error(model):
    found = strehl(model[None], model)
    assert found.peak.value == pytest.approx(1)
    assert np.isnan(found.peak.sigma)


def test_no_frames_no_light_and_a_peak_at_the_edge_are_errors(plane, model):
    with pytest.raises(CalibrationError, match="no science frames"):
        strehl(np.empty((0, *SHAPE)), model)
    with pytest.raises(CalibrationError, match="no light"):
        strehl_ratios(np.full(SHAPE, 7.0), model)
    edge = np.zeros(SHAPE)
    edge[0, 60] = 100.0
    with pytest.raises(CalibrationError, match="edge"):
        strehl_ratios(edge, model)
