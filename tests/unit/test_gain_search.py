"""The search for a matrix's best gain continues beyond its scan, towards either end."""

from __future__ import annotations

from dataclasses import replace

import fake_results
import numpy as np
import pytest

from escape_hw.api.procedure import run
from escape_hw.api.results import Estimate, StrehlEstimate
from escape_hw.calibration.loop import gain_search
from escape_hw.config.system import MAX_GAIN
from escape_hw.errors import CalibrationError


@pytest.mark.parametrize("top", [0.06, 0.15, 0.3, 0.9])
@pytest.mark.parametrize("limit", [0.2, 2.0])
def test_a_best_gain_at_the_edge_of_the_scan_is_none(monkeypatch, top, limit):
    """Whatever the scale of the matrix, the gain found is the loop's best within what was tried."""
    tried = []

    def loop(bench, matrix, grid, *, gain, **options):
        tried.append(gain)
        return replace(
            fake_results.loop(), gain=gain, stable=gain < limit, residual_rms_nm=50 + abs(np.log(gain / top)),
            strehl=None, partial=False,
        )  # fmt: skip
        yield

    monkeypatch.setattr(gain_search, "close_loop", loop)
    found, runs = run(gain_search.find_best_gain(None, fake_results.matrix(), None))
    assert len(runs) <= len(gain_search.GAIN_FRACTIONS) + 4
    assert min(tried) <= found <= max(tried)
    if top < limit:
        # Within the scan's finest step there, or the parabola's reach.
        assert abs(np.log(found / top)) < np.log(1.5)


def test_a_loop_that_closes_at_no_gain_is_reported(monkeypatch):
    def loop(bench, matrix, grid, *, gain, **options):
        return replace(fake_results.loop(), gain=gain, stable=False, partial=False)
        yield

    monkeypatch.setattr(gain_search, "close_loop", loop)
    with pytest.raises(CalibrationError, match=r"none of the gains .*0\.05"):
        run(gain_search.find_best_gain(None, fake_results.matrix(), None))


#: Gains of a scan, and Strehl ratios that rise steadily and fall steeply near the limit of stability.
GAINS = np.array([0.228, 0.319, 0.41, 0.501, 0.592, 0.683])
LOOP = fake_results.loop()


def strehl_at(gain):
    return 0.2 + 0.5 * gain - 0.02 * np.logaddexp(0, (gain - 0.63) / 0.02)


BEST = 0.63


def fitted(sigma, rng=None, gains=GAINS):
    """Gain and standard error from runs with Strehl ratios of a standard error."""
    runs = []
    for gain in gains:
        value = strehl_at(gain) + (0.0 if rng is None else sigma * rng.standard_normal())
        ratio = Estimate(float(value), sigma)
        runs.append(replace(LOOP, gain=float(gain), strehl=StrehlEstimate(ratio, ratio, ratio)))
    return gain_search._fit_peak(runs)


def test_an_asymmetric_curve_does_not_move_the_best_gain_to_the_edge_of_the_scan():
    trial = np.linspace(0.2, 0.7, 5001)
    assert trial[np.argmax(strehl_at(trial))] == pytest.approx(BEST, abs=1e-3)
    gain, sigma = fitted(0.003)
    assert abs(gain - BEST) < 0.02
    assert strehl_at(gain) > strehl_at(BEST) - 0.002
    assert 0.003 < sigma < 0.03


@pytest.mark.parametrize("strehl_sigma", [0.003, 0.01])
def test_the_error_of_the_best_gain_is_correct(strehl_sigma):
    results = np.array([fitted(strehl_sigma, np.random.default_rng(k)) for k in range(200)])
    pulls = (results[:, 0] - BEST) / results[:, 1]
    assert 0.4 < np.sqrt(np.mean(np.square(pulls))) < 1.5


#: Gains, Strehl ratios and their errors of a scan on ``razor-shwfs``; the last but one is best by chance.
SCATTERED = (
    (0.2276, 0.1506, 0.028), (0.3186, 0.2653, 0.0211), (0.4096, 0.2685, 0.0126),
    (0.5007, 0.2846, 0.0147), (0.5917, 0.3353, 0.0117), (0.6827, 0.3272, 0.0216),
)  # fmt: skip


@pytest.mark.parametrize("change", [-0.002, 0.0, 0.002])
def test_a_small_change_of_the_runs_changes_the_gain_a_little(change):
    runs = []
    for gain, value, sigma in SCATTERED:
        ratio = Estimate(value + change * (gain == 0.6827), sigma)
        runs.append(replace(LOOP, gain=gain, strehl=StrehlEstimate(ratio, ratio, ratio)))
    assert gain_search._fit_peak(runs)[0] == pytest.approx(0.68, abs=0.01)


def test_a_parabola_that_rises_beyond_the_last_run_is_followed(monkeypatch):
    known = {gain: Estimate(value, sigma) for gain, value, sigma in SCATTERED}

    def loop(bench, matrix, grid, *, gain, **options):
        ratio = known.get(gain, Estimate(0.31, 0.01))
        ratios = StrehlEstimate(ratio, ratio, ratio)
        return replace(fake_results.loop(), gain=gain, strehl=ratios, partial=False)
        yield

    monkeypatch.setattr(gain_search, "close_loop", loop)
    scan = tuple(known)
    monkeypatch.setattr(gain_search, "GAIN_FRACTIONS", scan)
    monkeypatch.setattr(gain_search, "gain_limit", lambda delay: 1.0)
    found = run(gain_search.find_best_gain(None, fake_results.matrix(), None))
    assert [one.gain for one in found.runs] == [*scan, pytest.approx(1.2 * scan[-1])]
    assert scan[-2] < found.gain < 1.2 * scan[-1]


def test_no_gain_beyond_the_largest_allowed_is_tried(monkeypatch):
    def loop(bench, matrix, grid, *, gain, **options):
        assert gain <= MAX_GAIN
        return replace(fake_results.loop(), gain=gain, strehl=None, residual_rms_nm=50 / gain, partial=False)
        yield

    monkeypatch.setattr(gain_search, "close_loop", loop)
    found = run(gain_search.find_best_gain(None, fake_results.matrix(), None, gains=None))
    monkeypatch.setattr(gain_search, "gain_limit", lambda delay: 2.0)
    fast = run(gain_search.find_best_gain(None, fake_results.matrix(), None))
    assert fast.gain == max(one.gain for one in fast.runs) == pytest.approx(1.8)
    assert found.gain < fast.gain


def test_few_runs_give_the_best_of_them_and_the_distance_of_its_neighbours():
    gain, sigma = fitted(0.003, gains=GAINS[1:4])
    assert gain == GAINS[3]
    assert sigma == pytest.approx((GAINS[3] - GAINS[2]) / np.sqrt(12))
    assert np.isnan(fitted(0.003, gains=GAINS[:1])[1])


def test_the_result_unpacks_as_gain_and_runs():
    search = gain_search.GainSearch(0.4, 0.02, [fake_results.loop()])
    gain, runs = search
    assert (gain, runs) == (search.gain, search.runs)
