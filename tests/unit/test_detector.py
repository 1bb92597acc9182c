"""The detector's counts have the specified mean, noise and limits."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import stats

from escape_sim.optics.detector import Detector

SHAPE = (64, 80)
DEFAULTS = {
    "bit_depth": 10,
    "full_well_e": 10000.0,
    "read_noise_e": 15.0,
    "dark_e": 0.0,
    "background_e": 400.0,
    "fixed_pattern": 0.0,
}


def detector(seed=0, **changes):
    return Detector(SHAPE, rng=np.random.default_rng(seed), **{**DEFAULTS, **changes})


def stack(camera, level, photons=1.0, n=60):
    image = np.full(SHAPE, level, np.float32)
    return np.array([camera.expose(image, photons)[0] for _ in range(n)], float)


ADU = 1023 / 10000.0


@pytest.mark.parametrize("electrons", [0.0, 300.0, 4000.0])
def test_mean_and_variance(electrons):
    frames = stack(detector(dark_e=25.0), electrons / 5, photons=5.0)
    mean = electrons + 25
    n = frames.size
    variance = ADU**2 * (mean + 15.0**2) + 1 / 12
    assert frames.mean() == pytest.approx(ADU * (mean + 400), abs=5 * np.sqrt(variance / n))
    assert frames.var() == pytest.approx(variance, rel=5 * np.sqrt(2 / n))


def test_each_pixel_has_its_own_noise():
    frames = stack(detector(), 2000.0, n=200)
    frames -= frames.mean(axis=0)
    per_pixel = frames.var(axis=0, ddof=1)
    assert per_pixel.std() / per_pixel.mean() == pytest.approx(np.sqrt(2 / 199), rel=0.15)
    # Neither neighbours nor successive frames know of each other.
    for left, right in (
        (frames[:, :, 1:], frames[:, :, :-1]),
        (frames[:, 1:], frames[:, :-1]),
        (frames[1:], frames[:-1]),
    ):
        assert abs(np.mean(left * right)) < 5 * frames.var() / np.sqrt(left.size)


def test_noise_is_symmetric():
    frames = stack(detector(read_noise_e=200.0), 5000.0)
    z = (frames - frames.mean()) / frames.std()
    assert abs((z**3).mean()) < 5 * np.sqrt(15 / z.size)
    assert (z**4).mean() == pytest.approx(3, abs=5 * np.sqrt(96 / z.size))


def test_noise_is_seeded():
    image = np.full(SHAPE, 2000.0, np.float32)
    first, again, other = (detector(seed).expose(image, 1.0)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_counts_are_rounded_to_the_nearest():
    camera = detector(read_noise_e=0.0, background_e=0.0, full_well_e=1023.0)
    # Full well at the converter's top: one electron per count; the noise is of the photons alone.
    frame, _ = camera.expose(np.zeros(SHAPE, np.float32), 1.0)
    assert not frame.any()
    # Nothing but a black level of so many counts.
    for level, want in ((41.3, 41), (41.7, 42), (300.4, 300)):
        still = detector(read_noise_e=0.0, background_e=level, full_well_e=1023.0)
        frame, _ = still.expose(np.zeros(SHAPE, np.float32), 1.0)
        assert (frame == want).all()


@pytest.mark.parametrize("bit_depth", [8, 10, 12, 16])
def test_the_top_is_exactly_the_bit_depths(bit_depth):
    camera = detector(bit_depth=bit_depth, read_noise_e=0.0)
    frame, saturated = camera.expose(np.full(SHAPE, 1e6, np.float32), 1.0)
    assert frame.dtype == np.uint16
    assert (frame == 2**bit_depth - 1).all()
    assert saturated == frame.size
    middle, none = camera.expose(np.full(SHAPE, 4600.0, np.float32), 1.0)
    assert middle.mean() == pytest.approx(0.5 * 2**bit_depth, rel=0.01)
    assert none == 0


@pytest.mark.parametrize("fixed_pattern", [0.0, 0.03])
def test_saturated_pixels_are_counted(fixed_pattern):
    camera = detector(fixed_pattern=fixed_pattern)
    image = np.full(SHAPE, 1000.0, np.float32)
    image[10:14, 20:27] = 40000.0
    frame, saturated = camera.expose(image, 1.0)
    assert saturated == 28
    assert (frame[10:14, 20:27] == camera.top).all()
    assert np.median(frame) < 0.2 * camera.top


def test_nothing_is_negative():
    camera = detector(read_noise_e=300.0, background_e=0.0)
    frames = stack(camera, 0.0)
    assert frames.min() == 0
    assert frames.max() < 0.5 * camera.top


def test_fixed_pattern_is_fixed():
    camera = detector(read_noise_e=1.0, fixed_pattern=0.02, bit_depth=16)
    dark, bright = (stack(camera, level, n=100).mean(axis=0) for level in (0.0, 5000.0))
    adu = 65535 / 10000
    gain = (bright - dark) / (5000 * adu)
    assert gain.mean() == pytest.approx(1, abs=5 * 0.02 / np.sqrt(gain.size))
    assert gain.std() == pytest.approx(0.02, rel=0.1)
    # Black levels scatter by the same share of 100 counts.
    assert dark.std() == pytest.approx(2.0, rel=0.15)
    again = stack(camera, 5000.0, n=100).mean(axis=0)
    assert np.corrcoef(bright.ravel(), again.ravel())[0, 1] > 0.98


COUNTING = {"read_noise_e": 0.0, "background_e": 0.0, "bit_depth": 16, "full_well_e": 65535.0}


@pytest.mark.parametrize("mean", [0.003, 0.4, 1.0, 3.37, 9.99, 19.99])
def test_faint_light_is_poisson(mean):
    # One count per electron; the dark signal is counted like the light.
    counts = stack(detector(**COUNTING, dark_e=0.25 * mean), 0.75 * mean, n=60).astype(int).ravel()
    most = int(mean + 8 * np.sqrt(mean) + 6)
    found = np.bincount(counts, minlength=most + 1)
    assert found.size == most + 1
    want = stats.poisson.pmf(np.arange(most + 1), mean) * counts.size
    likely = want > 10
    chi2 = ((found - want)[likely] ** 2 / want[likely]).sum()
    assert chi2 < stats.chi2.isf(1e-4, likely.sum())
    assert found[~likely].sum() < 10 * likely.size


@pytest.mark.parametrize("mean", [2.0, 15.0, 21.0, 300.0])
def test_mean_and_variance_hold_across_the_change_to_gaussian(mean):
    frames = stack(detector(**{**COUNTING, "read_noise_e": 0.6, "background_e": 20.0}), mean)
    variance = mean + 0.36 + 1 / 12
    fourth = np.sqrt((2 + 1 / mean) / frames.size)
    assert frames.mean() == pytest.approx(mean + 20, abs=5 * np.sqrt(variance / frames.size))
    assert frames.var() == pytest.approx(variance, rel=5 * fourth + 0.01)


@pytest.mark.parametrize("mean", [0.5, 6.0, 200.0])
@pytest.mark.parametrize("excess", [1.25, 1.4142])
def test_multiplication_adds_its_noise(mean, excess):
    camera = detector(**{**COUNTING, "background_e": 2000.0, "full_well_e": 6553.5}, excess_noise=excess)
    frames = (stack(camera, mean, n=100) - 20000) / 10
    # The rare large numbers of a faint light make its variance uncertain.
    kurtosis = 2 + 8 / mean
    variance = excess**2 * mean
    assert frames.mean() == pytest.approx(mean, abs=5 * np.sqrt(variance / frames.size))
    assert frames.var() == pytest.approx(variance, rel=5 * np.sqrt(kurtosis / frames.size) + 0.005)


def test_darkness_counts_nothing():
    assert not stack(detector(**COUNTING), 0.0).any()
    assert not stack(detector(**COUNTING, excess_noise=1.4), 0.0).any()


def test_counted_pixels_and_frames_are_independent():
    frames = stack(detector(**COUNTING), 4.0, n=80)
    frames -= frames.mean()
    for left, right in (
        (frames[:, :, 1:], frames[:, :, :-1]),
        (frames[:, 1:], frames[:, :-1]),
        (frames[1:], frames[:-1]),
    ):
        assert abs(np.mean(left * right)) < 5 * frames.var() / np.sqrt(left.size)


def test_counting_is_seeded():
    image = np.full(SHAPE, 5.0, np.float32)
    first, again, other = (detector(seed, **COUNTING).expose(image, 1.0)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_the_sky_is_counted_like_the_light():
    camera = detector(**COUNTING)
    frames = np.array([camera.expose(np.zeros(SHAPE, np.float32), 7.0, 3.0)[0] for _ in range(40)], float)
    assert frames.mean() == pytest.approx(3.0, abs=5 * np.sqrt(3 / frames.size))
    assert frames.var() == pytest.approx(3.0, rel=5 * np.sqrt(2.4 / frames.size))


@pytest.mark.parametrize("bit_depth", [8, 10, 12, 16])
@pytest.mark.parametrize("read_noise", [0.5, 20.0])
def test_overexposure_stops_at_the_top(bit_depth, read_noise):
    camera = detector(bit_depth=bit_depth, read_noise_e=read_noise, fixed_pattern=0.02)
    frame, saturated = camera.expose(np.full(SHAPE, 3e9, np.float32), 1.0)
    assert saturated == frame.size
    assert (frame == 2**bit_depth - 1).all()
