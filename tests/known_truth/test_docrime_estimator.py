"""The DO-CRIME estimator on runs whose matrix, response and noise are known."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.errors import CalibrationError, TooFewFrames

N_SLOPES, N_MODES = 60, 12
RESPONSE = np.array([0.0, 0.1, 0.75, 0.15, 0.0])


def make(frames, *, seed=0, turbulence=0.1, noise=2e-3, poke=0.01, order=2):
    """Slopes, pokes and the true matrix; slopes of a frame respond to the pokes of the frames before it."""
    rng = np.random.default_rng(seed)
    truth = rng.standard_normal((N_SLOPES, N_MODES))
    pokes = rng.uniform(-poke, poke, (frames, N_MODES))
    # Whatever the pokes' sizes, each mode has its own.
    pokes *= np.linspace(0.5, 1.5, N_MODES)
    seen = sum(w * np.roll(pokes, lag, axis=0) for lag, w in enumerate(RESPONSE))
    state = np.zeros((frames + 200, N_SLOPES))
    mix = np.eye(N_SLOPES) + 0.5 * np.eye(N_SLOPES, k=1)
    kicks = rng.standard_normal(state.shape) @ mix
    rate = np.array([1.95, -0.9525]) if order == 2 else np.array([0.99, 0.0])
    for k in range(2, len(state)):
        state[k] = rate[0] * state[k - 1] + rate[1] * state[k - 2] + kicks[k]
    normalised = state[200:] / state[200:].std()
    slopes = seen @ truth.T + turbulence * normalised + rng.normal(0, noise, (frames, N_SLOPES))
    return slopes.astype(np.float32), pokes, truth


def solved(slopes, pokes, keep=None, **options):
    estimator = DocrimeEstimator(N_SLOPES, N_MODES, **options)
    index = np.arange(len(slopes)) if keep is None else np.flatnonzero(keep)
    return estimator.extend(index, slopes[index], pokes[index]).solve()


def test_matrix_response_and_errors():
    slopes, pokes, truth = make(6000)
    s = solved(slopes, pokes)
    error = (s.matrix - truth) / s.sigma
    assert np.mean(error**2) == pytest.approx(1.0, abs=0.25)
    # Thirty times smaller than what the plain estimator leaves.
    plain = solved(slopes, pokes, order=0)
    assert np.linalg.norm(s.matrix - truth) < 0.1 * np.linalg.norm(plain.matrix - truth)
    assert s.response.weights == pytest.approx(RESPONSE, abs=0.01)
    assert np.abs((s.response.weights - RESPONSE) / s.response.sigma).max() < 4
    assert s.response.delay_frames == pytest.approx(RESPONSE @ np.arange(5), abs=0.02)


@pytest.mark.parametrize("turbulence", [0.02, 0.3])
def test_the_gain_is_not_biased(turbulence):
    gains = []
    for seed in range(4):
        slopes, pokes, truth = make(3000, seed=seed, turbulence=turbulence, order=1)
        matrix = solved(slopes, pokes).matrix
        gains.append(float((matrix * truth).sum() / (truth * truth).sum()))
    assert np.mean(gains) == pytest.approx(1.0, abs=0.02)


def test_the_response_is_not_biased_by_its_own_noise():
    # Strong turbulence on few frames: a matrix fitted to the same frames would find response
    # before the command was sent.
    early = []
    for seed in range(12):
        slopes, pokes, _ = make(600, seed=seed, turbulence=0.5, order=1)
        s = solved(slopes, pokes)
        early.append(s.response.weights[0] / s.response.sigma[0])
    assert abs(np.mean(early)) < 3 / np.sqrt(len(early))


def test_lost_frames_cost_pairs_and_shift_none():
    slopes, pokes, truth = make(6000)
    keep = np.random.default_rng(1).random(6000) > 0.01
    keep[[0, 2500, 2501, 2502, -1]] = [True, False, False, False, True]
    held = pokes.copy()
    # While a frame is lost the last poke stays on the mirror.
    for k in np.flatnonzero(~keep):
        held[k] = held[k - 1]
    seen = sum(w * np.roll(held - pokes, lag, axis=0) for lag, w in enumerate(RESPONSE))
    s = solved(slopes + (seen @ truth.T).astype(np.float32), pokes, keep)
    assert s.lost_frames == int((~keep).sum())
    assert s.frames == int(keep.sum())
    assert np.mean(((s.matrix - truth) / s.sigma) ** 2) == pytest.approx(1.0, abs=0.3)


def test_frame_by_frame_equals_all_at_once():
    slopes, pokes, _ = make(2500)
    one = DocrimeEstimator(N_SLOPES, N_MODES)
    for k in range(2500):
        one.partial_fit(k, slopes[k], pokes[k])
    whole = solved(slopes, pokes)
    assert np.allclose(one.solve().matrix, whole.matrix, rtol=0, atol=1e-5)
    three = DocrimeEstimator(N_SLOPES, N_MODES)
    for part in (slice(0, 700), slice(700, 1900), slice(1900, 2500)):
        three.extend(np.arange(2500)[part], slopes[part], pokes[part])
    assert np.allclose(three.solve().matrix, whole.matrix, rtol=0, atol=1e-5)


def test_solving_in_between_changes_nothing_afterwards():
    slopes, pokes, truth = make(4000)
    estimator = DocrimeEstimator(N_SLOPES, N_MODES)
    estimator.extend(np.arange(1500), slopes[:1500], pokes[:1500]).solve()
    s = estimator.extend(np.arange(1500, 4000), slopes[1500:], pokes[1500:]).solve()
    assert s.frames == 4000
    assert np.mean(((s.matrix - truth) / s.sigma) ** 2) == pytest.approx(1.0, abs=0.3)


def test_the_caller_may_reuse_its_arrays():
    slopes, pokes, _ = make(1200)
    estimator = DocrimeEstimator(N_SLOPES, N_MODES)
    slot, poke = np.empty(N_SLOPES, np.float32), np.empty(N_MODES)
    for k in range(1200):
        slot[:], poke[:] = slopes[k], pokes[k]
        estimator.partial_fit(k, slot, poke)
    assert np.allclose(estimator.solve().matrix, solved(slopes, pokes).matrix, rtol=0, atol=1e-5)


def test_a_short_run_still_gives_correct_errors():
    chi2 = []
    for seed in range(6):
        slopes, pokes, truth = make(120, seed=seed, turbulence=0.02)
        s = solved(slopes, pokes, order=2)
        chi2.append(np.mean(((s.matrix - truth) / s.sigma) ** 2))
    assert 0.4 < np.median(chi2) < 2.5


def test_the_plain_estimator_is_the_papers():
    slopes, pokes, _ = make(4000, turbulence=0.0)
    s = solved(slopes, pokes, order=0)
    seen = sum(w * pokes[4 - lag : 4000 - lag] for lag, w in enumerate(s.response.weights))
    x, y = seen - seen.mean(0), slopes[4:] - slopes[4:].mean(0)
    assert s.matrix == pytest.approx(np.linalg.solve(x.T @ x, x.T @ y).T, abs=5e-3)
    assert s.whitener.tolist() == [1.0]


def test_without_correlations_only_the_diagonal_is_known():
    slopes, pokes, _ = make(2000)
    whole, lean = solved(slopes, pokes), solved(slopes, pokes, correlations=False)
    assert np.array_equal(lean.matrix, whole.matrix)
    assert lean.variance == pytest.approx(np.diag(whole.covariance), rel=1e-3)
    assert lean.covariance is None


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_numbers_that_are_not_finite_are_refused(bad):
    slopes, pokes, _ = make(50)
    estimator = DocrimeEstimator(N_SLOPES, N_MODES)
    broken = slopes.copy()
    broken[20, 3] = bad
    with pytest.raises(ValueError, match="not finite"):
        estimator.partial_fit(0, broken[20], pokes[20])
    with pytest.raises(ValueError, match="not finite"):
        estimator.extend(np.arange(50), broken, pokes)
    with pytest.raises(ValueError, match="not finite"):
        estimator.partial_fit(0, slopes[0], np.full(N_MODES, bad))


def test_an_index_that_does_not_increase_is_refused():
    slopes, pokes, _ = make(50)
    estimator = DocrimeEstimator(N_SLOPES, N_MODES).partial_fit(7, slopes[0], pokes[0])
    with pytest.raises(ValueError, match="from 7 to 7"):
        estimator.partial_fit(7, slopes[1], pokes[1])
    with pytest.raises(ValueError, match="must increase"):
        estimator.extend(np.array([8, 8]), slopes[:2], pokes[:2])
    with pytest.raises(ValueError, match="must increase"):
        estimator.extend(np.array([6, 8]), slopes[:2], pokes[:2])


def test_too_few_frames_are_refused():
    slopes, pokes, _ = make(30)
    with pytest.raises(TooFewFrames, match="cannot constrain"):
        solved(slopes, pokes)


def test_pokes_that_leave_a_mode_alone_are_refused():
    slopes, pokes, _ = make(1500)
    pokes[:, 4] = 0
    with pytest.raises(CalibrationError, match="excite"):
        solved(slopes, pokes)


@pytest.mark.parametrize("at", [200, 1700])
def test_a_refused_frame_is_named_and_leaves_no_trace(at):
    slopes, pokes, _ = make(2500)
    broken = slopes.copy()
    broken[at, 3] = np.nan
    one, many = DocrimeEstimator(N_SLOPES, N_MODES), DocrimeEstimator(N_SLOPES, N_MODES)
    many.extend(np.arange(100), slopes[:100], pokes[:100])
    with pytest.raises(ValueError, match=f"frame {at}: .*not finite"):
        many.extend(np.arange(100, 2500), broken[100:], pokes[100:])
    many.extend(np.arange(100, 2500), slopes[100:], pokes[100:])
    for k in range(2500):
        if k == at:
            with pytest.raises(ValueError, match=f"frame {at}: .*not finite"):
                one.partial_fit(k, broken[k], pokes[k])
        one.partial_fit(k, slopes[k], pokes[k])
    assert np.array_equal(one.solve().matrix, many.solve().matrix)
    assert one.frames == 2500


def test_frames_that_are_too_few_to_begin_with_are_not_forgotten():
    # One row in 51 has a whole past, so the first thousand frames hold fewer than the 37 needed.
    slopes, pokes, truth = make(9000, turbulence=0.02)
    keep = np.random.default_rng(0).random(9000) > 0.43
    keep[0] = True
    held = pokes.copy()
    for k in np.flatnonzero(~keep):
        held[k] = held[k - 1]
    seen = sum(w * np.roll(held - pokes, lag, axis=0) for lag, w in enumerate(RESPONSE))
    slopes += (seen @ truth.T).astype(np.float32)
    index = np.flatnonzero(keep)
    with pytest.raises(TooFewFrames):
        solved(slopes[:1001], pokes[:1001], keep[:1001])
    estimator = DocrimeEstimator(N_SLOPES, N_MODES).extend(index, slopes[index], pokes[index])
    s = estimator.solve()
    assert s.frames == int(keep.sum())
    assert s.lost_frames == index[-1] + 1 - index.size
    # So few frames leave the response, and with it the gain common to all elements, uncertain.
    gain = float(np.vdot(s.matrix, truth) / np.vdot(truth, truth))
    assert gain == pytest.approx(1, abs=0.15)
    assert np.mean(((s.matrix - gain * truth) / s.sigma) ** 2) == pytest.approx(1.0, abs=0.3)


@pytest.mark.parametrize("correlations", [True, False])
@pytest.mark.parametrize("order", [0, 6])
def test_a_mirror_that_nothing_answers_to_is_refused(correlations, order):
    slopes, pokes, _ = make(3000, poke=0.0)
    poked = np.random.default_rng(9).uniform(-0.01, 0.01, pokes.shape)
    with pytest.raises(CalibrationError, match="does not respond"):
        solved(slopes, poked, correlations=correlations, order=order)
