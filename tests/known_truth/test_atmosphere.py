"""Open-air turbulence has von Karman statistics in space, frozen flow and boiling in time.

The second route is the covariance of the phase in closed form (Conan 2000), which shares nothing with
the Fourier synthesis under test.
"""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy import special

from escape_hw.config.twin import TwinAtmosphere
from escape_sim.atmosphere.layers import Atmosphere, TurbulentLayer, screen_pixels
from escape_sim.atmosphere.von_karman import TurbulenceSource, spline_gain

PIXEL, R0, OUTER_SCALE, N, SIZE = 0.1, 0.16, 20.0, 48, 256
LIT = np.ones((N, N), bool)
SEEDS = 300
#: Even with this outer scale in metres the structure function over 5 m is 0.3 % below Kolmogorov's.
KOLMOGOROV = 1e9


def covariance(r, r0=R0, outer_scale=OUTER_SCALE):
    """Covariance of the phase in rad^2 (Conan 2000)."""
    x = 2 * np.pi * np.maximum(r, 1e-9 * outer_scale) / outer_scale
    c = (24 / 5 * special.gamma(6 / 5)) ** (5 / 6) * special.gamma(11 / 6)
    c /= 2 ** (5 / 6) * np.pi ** (8 / 3)
    return c * (outer_scale / r0) ** (5 / 3) * x ** (5 / 6) * special.kv(5 / 6, x)


def structure_function(r, outer_scale):
    if math.isinf(outer_scale):
        return 6.88 * (r / R0) ** (5 / 3)
    return 2 * (covariance(0.0, outer_scale=outer_scale) - covariance(r, outer_scale=outer_scale))


def make_layer(seed, outer_scale=OUTER_SCALE, wind=(0.0, 0.0), boiling=math.inf, size=SIZE, worker=None):
    source = TurbulenceSource(size, PIXEL, R0, outer_scale, N + 3)
    return TurbulentLayer(source, 1.0, wind, boiling, LIT, np.random.SeedSequence(seed), worker)


def phase(layer, time):
    out = np.zeros((N, N), np.float32)
    layer.add(time, out)
    return out.astype(float)


def pupils(outer_scale, wind, time):
    """Independent pupils ``(SEEDS, N, N)``, read between the pixels, at different places of the screen."""
    source = TurbulenceSource(SIZE, PIXEL, R0, outer_scale, N + 3)
    seeds = (np.random.SeedSequence(seed) for seed in range(SEEDS))
    return np.array([phase(TurbulentLayer(source, 1.0, wind, 3.0, LIT, seed), time) for seed in seeds])


@pytest.fixture(scope="module")
def karman():
    return pupils(OUTER_SCALE, (7.03, 3.41), 1.37)


@pytest.fixture(scope="module")
def kolmogorov():
    return pupils(KOLMOGOROV, (7.03, 3.41), 1.37)


@pytest.mark.parametrize("pixels", [4, 8, 16, 32, 47])
@pytest.mark.parametrize("axis", [1, 2])
def test_von_karman_structure_function(karman, pixels, axis):
    check_structure(karman, pixels, axis, OUTER_SCALE)


@pytest.mark.parametrize("pixels", [4, 8, 16, 32, 47])
@pytest.mark.parametrize("axis", [1, 2])
def test_kolmogorov_structure_function(kolmogorov, pixels, axis):
    check_structure(kolmogorov, pixels, axis, math.inf)


def check_structure(stack, pixels, axis, outer_scale):
    a = np.take(stack, np.arange(N - pixels), axis)
    b = np.take(stack, np.arange(pixels, N), axis)
    each = ((a - b) ** 2).mean(axis=(1, 2))
    scatter = each.std(ddof=1) / math.sqrt(SEEDS)
    want = structure_function(pixels * PIXEL, outer_scale)
    # Waves shorter than two pixels are missing: 0.55 (pixel / r0)^(5/3) at most.
    missing = 0.55 * (PIXEL / R0) ** (5 / 3)
    assert want - missing - 4 * scatter < each.mean() < want + 4 * scatter + 0.005 * want
    assert scatter < 0.1 * want


@pytest.mark.parametrize("size", [256, 1024])
@pytest.mark.parametrize("outer_scale", [3.0, 25.0, 1e5, KOLMOGOROV])
def test_the_spectrum_that_is_drawn_has_the_right_structure_function(size, outer_scale):
    """Without any statistics: the sum over all components drawn, at the pixels of the screen."""
    source = TurbulenceSource(size, PIXEL, R0, outer_scale, N + 3)
    gain = np.outer(spline_gain(np.fft.fftfreq(size)), spline_gain(np.arange(size // 2 + 1) / size))
    # Real and imaginary part, and the conjugate; where a column mirrors itself half of it is lost.
    power = 4 * np.square(source._amplitude / gain, dtype=float)
    power[:, [0, -1]] /= 4
    fx = np.arange(size // 2 + 1) / (size * PIXEL)
    waves = source.wave_frequencies[:, 0]
    for pixels in (2, 4, 8, 16, 32, 47):
        r = pixels * PIXEL
        found = 2 * (power * (1 - np.cos(2 * np.pi * fx * r))).sum()
        found += 4 * (source._wave_rms**2 * (1 - np.cos(2 * np.pi * waves * r))).sum()
        want = structure_function(r, math.inf if outer_scale == KOLMOGOROV else outer_scale)
        missing = 0.55 * (PIXEL / R0) ** (5 / 3)
        assert found == pytest.approx(want - 0.8 * missing, abs=0.2 * missing + 0.012 * want)


def zernikes():
    """Noll's modes 2 to 11 on the pupil, orthonormal over it, as rows."""
    line = (np.arange(N) - (N - 1) / 2) / (N / 2)
    x, y = np.meshgrid(line, line)
    r2, inside = x**2 + y**2, x**2 + y**2 <= 1
    polynomials = [
        np.ones_like(x), 2 * x, 2 * y, math.sqrt(3) * (2 * r2 - 1), math.sqrt(24) * x * y,
        math.sqrt(6) * (x**2 - y**2), math.sqrt(8) * (3 * r2 - 2) * y, math.sqrt(8) * (3 * r2 - 2) * x,
        math.sqrt(8) * (3 * x**2 * y - y**3), math.sqrt(8) * (x**3 - 3 * x * y**2),
        math.sqrt(5) * (6 * r2**2 - 6 * r2 + 1),
    ]  # fmt: skip
    q, r = np.linalg.qr(np.array([z[inside] for z in polynomials]).T)
    return (q * np.sign(np.diag(r))).T[1:] / math.sqrt(inside.sum()), inside


def test_zernike_variances_against_the_covariance_matrix(karman):
    modes, inside = zernikes()
    rows, columns = np.nonzero(inside)
    distance = np.hypot(rows[:, None] - rows, columns[:, None] - columns) * PIXEL
    want = np.einsum("mi,ij,mj->m", modes, covariance(distance), modes)
    found = (karman[:, inside] @ modes.T).var(axis=0)
    assert found == pytest.approx(want, rel=4.5 * math.sqrt(2 / SEEDS))
    assert found.sum() == pytest.approx(want.sum(), rel=0.2)


def test_zernike_variances_against_noll(kolmogorov):
    # Noll (1976), Table IV: 0.448 each for tip and tilt, 0.0232 for focus and astigmatism, ...
    modes, inside = zernikes()
    noll = np.array([0.448, 0.448, 0.0232, 0.0232, 0.0232, 0.00619, 0.00619, 0.00619, 0.00619, 0.00245])
    found = (kolmogorov[:, inside] @ modes.T).var(axis=0)
    want = noll * (N * PIXEL / R0) ** (5 / 3)
    assert found == pytest.approx(want, rel=4.5 * math.sqrt(2 / SEEDS))
    # Tip and tilt together, and the rest together, bind more tightly.
    for part in (slice(0, 2), slice(2, 10)):
        n = SEEDS * (part.stop - part.start)
        assert found[part].sum() == pytest.approx(want[part].sum(), rel=4.5 * math.sqrt(2 / n))


def test_waves_longer_than_the_screen_are_needed_and_used_only_then():
    assert len(TurbulenceSource(SIZE, PIXEL, R0, 5.0, N + 3).wave_frequencies) == 0
    long = TurbulenceSource(SIZE, PIXEL, R0, 1e5, N + 3).wave_frequencies
    assert 0 < np.abs(long).max() < 1 / (SIZE * PIXEL)


def test_the_power_lost_between_the_pixels():
    """The finest structure is right on average over places, the coarser at each of them."""
    layers = [make_layer(seed, outer_scale=3.0, wind=(1.0, 1.0)) for seed in range(40)]
    ratios = {1: [], 2: [], 4: []}
    for place in (0.0, 0.25, 0.5, 0.75):
        stack = np.array([phase(layer, place * PIXEL) for layer in layers])
        for pixels, found in ratios.items():
            measured = ((stack[:, :, pixels:] - stack[:, :, :-pixels]) ** 2).mean()
            found.append(measured / structure_function(pixels * PIXEL, 3.0))
    # Waves shorter than two pixels are missing, and those just longer fade midway between pixels.
    for pixels, least, swing in ((1, 0.86, 0.3), (2, 0.95, 0.1), (4, 0.98, 0.03)):
        found = np.array(ratios[pixels])
        assert least < found.mean() < 1.03
        assert np.ptp(found) < swing


def test_frozen_flow_moves_the_pattern_with_the_wind():
    # Three pixels to the right and one up per 10 ms: what was at (i, j) is found at (i - 1, j + 3).
    layer = make_layer(3, wind=(30.0, -10.0), size=1024)
    before, after = phase(layer, 0.5), phase(layer, 0.51)
    moved = before[1:, : N - 3]
    stays = np.std(after[: N - 1, 3:] - moved) / np.std(before)
    assert stays < 0.02
    assert np.std(after - before) > 5 * stays * np.std(before)


@pytest.mark.parametrize("lag", [0.3, *(pytest.param(lag, marks=pytest.mark.slow) for lag in (0.05, 0.8))])
def test_space_and_time_covariance(lag):
    """Frozen flow and boiling together: <p(x, t) p(x + r, t + lag)> = rho(lag) C(r - v lag)."""
    boiling, wind = 0.5, (6.0, 2.0)
    source = TurbulenceSource(SIZE, PIXEL, R0, 3.0, N + 3)
    products, shifts = [], [(0, 0), (3, 1), (18, 6), (0, 12)]
    for seed in range(300):
        layer = TurbulentLayer(source, 1.0, wind, boiling, LIT, np.random.SeedSequence(seed))
        a, b = phase(layer, 0.2), phase(layer, 0.2 + lag)
        products.append([(a[: N - v, : N - u] * b[v:, u:]).mean() for u, v in shifts])
    turn = 1.474456 * lag / boiling
    rho = ((math.pi - turn) * math.cos(turn) + math.sin(turn)) / math.pi if turn < math.pi else 0.0
    scatter = np.std(products, axis=0, ddof=1) / math.sqrt(len(products))
    for (u, v), found, error in zip(shifts, np.mean(products, axis=0), scatter, strict=True):
        r = math.hypot(u * PIXEL - wind[0] * lag, v * PIXEL - wind[1] * lag)
        # A screen of 25 m has no mean: its covariance lacks the mean of the true one over its area.
        missing = covariance_integral(3.0) / (SIZE * PIXEL) ** 2
        assert found == pytest.approx(rho * (covariance(r, outer_scale=3.0) - missing), abs=4.5 * error)


def covariance_integral(outer_scale):
    return 0.0229 * R0 ** (-5 / 3) * outer_scale ** (11 / 3)


def test_boiling_time_is_the_time_to_one_over_e():
    turn = 1.474456
    assert make_layer(0, boiling=0.7).rate == pytest.approx(turn / 0.7)
    rho = ((math.pi - turn) * math.cos(turn) + math.sin(turn)) / math.pi
    assert rho == pytest.approx(1 / math.e, abs=1e-6)
    assert make_layer(0).rate == 0
    # Wind across a small screen renews it before it comes round.
    assert make_layer(0, wind=(40.0, 0.0)).rate > turn * 40.0 / (SIZE * PIXEL)


def test_turbulence_without_wind_and_boiling_is_constant():
    layer = make_layer(1)
    assert np.array_equal(phase(layer, 0.0), phase(layer, 1000.0))


def test_stationary_over_a_long_run():
    """Variance and tilt stay the same over 200 s, through a hundred renewals."""
    layer = make_layer(11, outer_scale=3.0, wind=(9.0, -4.0), boiling=2.0)
    times = np.arange(0.0, 200.0, 0.5)
    variance = np.array([phase(layer, t).var() for t in times]).reshape(4, -1)
    means, errors = variance.mean(axis=1), variance.std(axis=1) / math.sqrt(variance.shape[1] / 2)
    assert np.abs(means - means.mean()).max() < 4.5 * errors.max()
    distance = np.hypot(*np.meshgrid(np.arange(N), np.arange(N))) * PIXEL
    weight = (N - np.arange(N)) * np.where(np.arange(N) == 0, 1, 2)
    mean_covariance = (np.outer(weight, weight) * covariance(distance, outer_scale=3.0)).sum() / N**4
    want = covariance(0.0, outer_scale=3.0) - mean_covariance
    assert variance.mean() == pytest.approx(want, rel=0.15)


def test_nothing_repeats_in_a_long_run():
    """At any two of 400 moments spread over 100,000 frames of 2 ms the pupils are unlike each other."""
    layer = make_layer(5, outer_scale=1.0, wind=(12.8, 0.0), size=512)
    # A wind along an axis comes back to the same pixels of the screen every 4 s sharp.
    stack = np.array([phase(layer, t).ravel() for t in np.arange(50) * 4.0])
    stack -= stack.mean(axis=1, keepdims=True)
    stack /= np.linalg.norm(stack, axis=1, keepdims=True)
    likeness = stack @ stack.T - np.eye(len(stack))
    assert np.abs(likeness).max() < 0.7
    assert np.abs(likeness).mean() < 0.15


def test_it_is_seeded_and_the_order_of_asking_does_not_matter():
    with ThreadPoolExecutor(1) as worker:
        first = make_layer(4, wind=(20.0, 5.0), boiling=0.2, worker=worker)
        other = make_layer(4, wind=(20.0, 5.0), boiling=0.2)
        times = [0.0, 0.3, 0.31, 0.9, 1.3, 1.31, 5.0]
        forward = [phase(first, t) for t in times]
        backward = [phase(other, t) for t in reversed(times)][::-1]
    assert np.array_equal(forward, backward)
    assert not np.allclose(forward[0], phase(make_layer(5, wind=(20.0, 5.0), boiling=0.2), 0.0))


def test_it_may_be_evaluated_at_times_before_zero():
    layer = make_layer(4, wind=(20.0, 5.0), boiling=0.2)
    values = [phase(layer, t).std() for t in (-3.0, -0.01)]
    assert min(values) > 0


def settings(**changes):
    values = {
        "r0_m": R0, "outer_scale_m": OUTER_SCALE, "fraction": (0.7, 0.3), "speed_m_s": (8.0, 20.0),
        "direction_deg": (0.0, 90.0), "boiling_s": 1.0,
    }  # fmt: skip
    return TwinAtmosphere(**{**values, **changes})


def test_layers_add_in_variance_and_r0_is_at_500_nm():
    sky = Atmosphere(settings(), PIXEL, LIT, np.random.SeedSequence(3))
    opd = np.zeros((N, N), np.float32)
    sky.add(0.4, opd)
    parts = [phase(layer, 0.4) for layer in sky.layers]
    assert opd == pytest.approx(sum(parts), abs=1e-12)
    source = TurbulenceSource(1024, PIXEL, R0, OUTER_SCALE, N + 3)
    for number, (fraction, wind) in enumerate(((0.7, (8.0, 0.0)), (0.3, (0.0, 20.0)))):
        seed = np.random.SeedSequence(3, spawn_key=(number,))
        layer = TurbulentLayer(source, 1.0, wind, 1.0, LIT, seed)
        want = phase(layer, 0.4) * math.sqrt(fraction) * 500e-9 / (2 * math.pi)
        assert parts[number] == pytest.approx(want, abs=1e-3 * np.std(want))


def test_layers_differ_and_blow_where_they_should():
    lit = np.ones((N, N), bool)
    sky = Atmosphere(settings(boiling_s=math.inf), PIXEL, lit, np.random.SeedSequence(1))
    right, up = sky.layers
    a, b = phase(right, 0.0), phase(right, 0.05)
    scale = np.std(a)
    assert np.std(b[:, 4:] - a[:, :-4]) < 0.04 * scale
    c, d = phase(up, 0.0), phase(up, 0.02)
    assert np.std(d[4:] - c[:-4]) < 0.04 * np.std(c)
    assert abs(np.corrcoef(a.ravel(), c.ravel())[0, 1]) < 0.95


def test_dark_samples_are_left_alone():
    lit = np.hypot(*np.meshgrid(*[np.arange(N) - (N - 1) / 2] * 2)) < N / 2
    source = TurbulenceSource(SIZE, PIXEL, R0, 3.0, N + 3)
    layer = TurbulentLayer(source, 1.0, (3.0, 1.0), 1.0, lit, np.random.SeedSequence(2))
    whole = TurbulentLayer(source, 1.0, (3.0, 1.0), 1.0, LIT, np.random.SeedSequence(2))
    part, full = phase(layer, 0.37), phase(whole, 0.37)
    assert part[lit] == pytest.approx(full[lit], abs=1e-5)
    assert not part[0, 0]
    assert not part[-1, -1]


@pytest.mark.parametrize(("n", "want"), [(48, 1024), (128, 1024), (129, 2048), (240, 2048), (320, 4096)])
def test_size_of_the_screens(n, want):
    assert screen_pixels(n) == want


def test_unsuitable_screens_are_refused():
    with pytest.raises(ValueError, match="power of two"):
        TurbulenceSource(200, PIXEL, R0, 3.0, 20)
    with pytest.raises(ValueError, match="needs 51"):
        TurbulentLayer(
            TurbulenceSource(SIZE, PIXEL, R0, 3.0, 20), 1.0, (0.0, 0.0), 1.0, LIT, np.random.SeedSequence(1)
        )
