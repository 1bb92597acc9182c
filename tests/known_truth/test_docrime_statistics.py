"""DO-CRIME over many seeds: injected matrices and delays are recovered within their stated errors."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from escape_hw.calibration.docrime.estimator import DocrimeEstimator

N_SLOPES, N_MODES, LAGS, ORDER = 40, 10, 5, 4
FRAMES = 1500
#: Delay in frames: share of the response in each of the frames after a command.
RESPONSES = {
    1.0: [0.0, 1.0, 0.0, 0.0, 0.0],
    1.3: [0.0, 0.7, 0.3, 0.0, 0.0],
    2.0: [0.0, 0.0, 1.0, 0.0, 0.0],
    2.55: [0.0, 0.0, 0.45, 0.55, 0.0],
}


def run(seed, delay=2.0, pole=0.98, turbulence=0.3, noise=2e-3, poke=0.01, frames=FRAMES):
    """AR(1) turbulence with ``turbulence`` pixels rms, and pokes of a few hundredths of that."""
    rng = np.random.default_rng(seed)
    truth = rng.standard_normal((N_SLOPES, N_MODES))
    pokes = rng.uniform(-poke, poke, (frames, N_MODES))
    weights = np.asarray(RESPONSES[delay])
    seen = lfilter(weights, [1.0], pokes, axis=0)
    kicks = rng.standard_normal((frames + 300, N_SLOPES)) * np.sqrt(1 - pole**2)
    red_noise = lfilter([1.0], [1.0, -pole], kicks, axis=0)[300:]
    slopes = seen @ truth.T + turbulence * red_noise + rng.normal(0, noise, (frames, N_SLOPES))
    return slopes.astype(np.float32), pokes, truth


def solve(slopes, pokes, order=ORDER, index=None):
    index = np.arange(len(slopes)) if index is None else index
    return DocrimeEstimator(N_SLOPES, N_MODES, order=order, lags=LAGS).extend(index, slopes, pokes).solve()


def split(s, truth):
    """Common gain of an estimate, and its errors beside that gain in units of the stated ones."""
    gain = float(np.vdot(s.matrix, truth) / np.vdot(truth, truth))
    return gain, (s.matrix - gain * truth) / s.sigma


@pytest.mark.parametrize("delay", RESPONSES)
@pytest.mark.parametrize("frames", [FRAMES, 3000])
def test_injected_matrices_and_delays_are_recovered(delay, frames):
    gains, errors, delays, weights = [], [], [], []
    for seed in range(8):
        slopes, pokes, truth = run(seed, delay, turbulence=0.1, frames=frames)
        s = solve(slopes, pokes)
        gain, z = split(s, truth)
        gains.append(gain)
        errors.append(z)
        delays.append(s.response.delay_frames)
        weights.append((s.response.weights - RESPONSES[delay]) / s.response.sigma)
        assert s.response.weights.sum() == pytest.approx(1)
    # Five standard deviations of chi-squared.
    chi2 = np.square(errors)
    assert chi2.mean() == pytest.approx(1, abs=5 * np.sqrt(2 / chi2.size))
    assert np.mean(gains) == pytest.approx(1, abs=0.02)
    assert np.std(gains) < 0.05
    assert np.mean(delays) == pytest.approx(delay, abs=0.02)
    # 40 weights, which are not independent.
    assert 0.3 < np.mean(np.square(weights)) < 2


def test_normalised_errors_are_standard_normal():
    z = np.array([split(solve(slopes, pokes), truth)[1] for slopes, pokes, truth in map(run, range(10, 26))])
    assert abs(z.mean()) < 5 / np.sqrt(z.size)
    assert z.std() == pytest.approx(1, abs=0.04)
    assert np.mean(np.abs(z) < 1.96) == pytest.approx(0.95, abs=0.01)
    # Neither single modes nor single slopes stand out.
    for axis in ((0, 1), (0, 2)):
        part = np.mean(z**2, axis=axis)
        assert np.abs(part - 1).max() < 5 * np.sqrt(2 * part.size / z.size)


@pytest.mark.parametrize(("delay", "turbulence"), [(2.0, 0.1), (2.55, 0.1), (2.55, 0.3)])
def test_the_stated_error_of_the_gain_is_its_scatter(delay, turbulence):
    pulls = []
    for seed in range(100, 124):
        slopes, pokes, truth = run(seed, delay, turbulence=turbulence)
        s = solve(slopes, pokes)
        pulls.append((split(s, truth)[0] - 1) / s.gain_sigma)
    # Chi-squared of 24 degrees of freedom scatters by 0.29 about one.
    assert 0.3 < np.mean(np.square(pulls)) < 2.0


def test_the_gain_is_known_better_from_more_frames():
    few, many = (solve(*run(3, 2.55, frames=n)[:2]).gain_sigma for n in (FRAMES, 6000))
    assert many == pytest.approx(few / 2, rel=0.3)


@pytest.mark.parametrize("frames", [FRAMES, 4000])
def test_the_plain_estimators_response_does_not_suffer_from_the_turbulence(frames):
    # It comes from frame differences, however long the run.
    found = [solve(*run(seed, frames=frames)[:2], order=0).response for seed in range(8)]
    delays = [response.delay_frames for response in found]
    assert np.mean(delays) == pytest.approx(2, abs=0.05)
    assert np.std(delays) < 0.12
    z = np.array([(response.weights - RESPONSES[2.0]) / response.sigma for response in found])
    assert 0.3 < np.mean(z**2) < 2


def test_whitening_beats_the_plain_estimator_fivefold():
    ratios = []
    for seed in range(6):
        slopes, pokes, truth = run(seed, pole=0.995)
        white, plain = (np.linalg.norm(solve(slopes, pokes, order).matrix - truth) for order in (ORDER, 0))
        ratios.append(plain / white)
    assert np.min(ratios) > 5


def test_against_white_noise_whitening_costs_nothing():
    ratios = []
    for seed in range(6):
        slopes, pokes, truth = run(seed, pole=0.0, turbulence=0.02)
        white, plain = (np.linalg.norm(solve(slopes, pokes, order).matrix - truth) for order in (ORDER, 0))
        ratios.append(white / plain)
    assert np.mean(ratios) < 1.05


def test_errors_fall_with_the_root_of_the_number_of_frames():
    short, long = (
        np.mean([np.median(solve(*run(seed, turbulence=0.03, frames=n)[:2]).sigma) for seed in range(3)])
        for n in (1200, 4800)
    )
    assert short / long == pytest.approx(2, rel=0.03)


def test_single_precision_is_enough():
    # The same regression in double precision, with the filter and the response that the sums were made with.
    slopes, pokes, _ = run(3)
    estimator = DocrimeEstimator(N_SLOPES, N_MODES, order=ORDER, lags=LAGS)
    s = estimator.extend(np.arange(FRAMES), slopes, pokes).solve()
    response = estimator.state()[1]["response"]
    y = lfilter(s.whitener, [1.0], slopes.astype(float), axis=0)
    x = lfilter(np.convolve(s.whitener, response), [1.0], pokes, axis=0)
    at = slice(ORDER + LAGS + ORDER, None)
    x, y = x[at] - x[at].mean(axis=0), y[at] - y[at].mean(axis=0)
    want = np.linalg.solve(x.T @ x, x.T @ y).T
    # The response of all frames scales the whole.
    scale = np.vdot(want, s.matrix) / np.vdot(want, want)
    assert scale == pytest.approx(1, abs=0.01)
    assert np.abs(s.matrix - scale * want).max() < 0.15 * np.median(s.sigma)


def test_an_offset_and_a_large_mean_do_not_matter():
    slopes, pokes, truth = run(4)
    far = slopes + np.linspace(-6, 6, N_SLOPES, dtype=np.float32)
    s = solve(far, pokes + 0.05, index=np.arange(FRAMES) + 10**12)
    assert np.mean(((s.matrix - truth) / s.sigma) ** 2) == pytest.approx(1, abs=0.3)


@pytest.mark.parametrize("lost", [0.002, 0.05])
def test_lost_frames_bias_nothing(lost):
    chi2 = []
    for seed in range(4):
        rng = np.random.default_rng(100 + seed)
        truth = rng.standard_normal((N_SLOPES, N_MODES))
        frames = 2500
        kept = np.flatnonzero(rng.random(frames) > lost)
        pokes = rng.uniform(-0.01, 0.01, (frames, N_MODES))
        # A poke is sent when a frame has arrived; no frame, no new poke.
        on = np.searchsorted(kept, np.arange(frames), side="right") - 1
        held = np.where((on >= 0)[:, None], pokes[kept[np.maximum(on, 0)]], 0.0)
        seen = lfilter(RESPONSES[2.55], [1.0], held, axis=0)
        red_noise = lfilter([1.0], [1.0, -0.98], 0.06 * rng.standard_normal((frames, N_SLOPES)), axis=0)
        slopes = (seen @ truth.T + red_noise + rng.normal(0, 2e-3, red_noise.shape)).astype(np.float32)
        s = solve(slopes[kept], pokes[kept], index=kept)
        assert s.lost_frames == kept[-1] - kept[0] + 1 - kept.size
        chi2.append(np.mean(((s.matrix - truth) / s.sigma) ** 2))
    assert np.mean(chi2) == pytest.approx(1, abs=0.15)


@pytest.mark.parametrize("at", [300, 1300, 1999])
def test_a_long_gap_separates_two_runs(at):
    slopes, pokes, truth = run(6, frames=2400)
    index = np.arange(2400)
    # Weeks at 500 frames per second; memory must not grow with them.
    index[at:] += 10**9
    s = solve(slopes, pokes, index=index)
    assert s.lost_frames == 10**9
    assert s.frames == 2400
    assert np.mean(split(s, truth)[1] ** 2) == pytest.approx(1, abs=0.3)
    one = DocrimeEstimator(N_SLOPES, N_MODES, order=ORDER, lags=LAGS)
    for k in range(2400):
        one.partial_fit(int(index[k]), slopes[k], pokes[k])
    assert one.solve().matrix == pytest.approx(s.matrix, abs=1e-4)
    assert one.lost_frames == 10**9
