"""Durations in bins: percentiles right within 3 %, at any scale, and the spacing of a loop's frames."""

from __future__ import annotations

import math

import numpy as np
import pytest

from escape_hw.streams.timing import BINS, MIDDLES, Histogram, LoopTiming, bin_of, percentiles_of


def test_bins_follow_each_other_and_hold_their_middles():
    assert MIDDLES.shape == (BINS,)
    assert (np.diff(MIDDLES) > 0).all()
    for number, middle in enumerate(MIDDLES):
        assert bin_of(int(middle)) == number
    numbers = [bin_of(value) for value in range(100_000)]
    assert numbers == sorted(numbers)
    assert set(np.diff(numbers)) == {0, 1}


@pytest.mark.parametrize("value", [-5, 0, 15, 16, 31, 32, 10**3, 10**6, 10**9, 2**40 - 1])
def test_a_middle_is_within_three_percent(value):
    assert abs(MIDDLES[bin_of(value)] - max(value, 0)) <= 0.032 * max(value, 0)


def test_what_is_beyond_the_last_bin_counts_in_it():
    assert bin_of(2**63) == BINS - 1


@pytest.mark.parametrize("scale", [1e3, 1e5, 1e8])
def test_percentiles_agree_with_the_values_themselves(scale):
    values = (scale * np.random.default_rng(1).lognormal(0, 1, 20_000)).astype(np.int64)
    counts = Histogram()
    for value in values.tolist():
        counts.add(value)
    found = np.array(counts.percentiles(1, 50, 99, 99.9)) * 1e3
    np.testing.assert_allclose(found, np.percentile(values, [1, 50, 99, 99.9]), rtol=0.04)
    assert counts.largest == values.max()
    assert counts.total == values.size


def test_nothing_counted_is_nan():
    assert all(math.isnan(value) for value in Histogram().percentiles(50, 99))
    assert math.isnan(Histogram().deviation_percentile(99))
    assert np.isnan(percentiles_of(np.zeros(BINS), [50])).all()
    assert math.isnan(LoopTiming().recent().p50)
    assert math.isnan(LoopTiming().since_start().p99)


def test_a_loop_reports_its_last_second_and_its_total():
    timing, rng, now = LoopTiming(), np.random.default_rng(2), 10**12
    spacings, latencies = [], []
    for number in range(6000):
        step = 2_000_000 + int(rng.normal(0, 20_000))
        took = (300_000 if number < 3000 else 100_000) + int(rng.exponential(10_000))
        now += step
        timing.add(now, now + took)
        spacings.append(step)
        latencies.append(took)
    recent, ever = timing.recent(), timing.since_start()
    last = np.array(latencies[-500:]) / 1e3
    np.testing.assert_allclose(
        [recent.p50, recent.p99, recent.largest], np.percentile(last, [50, 99, 100]), rtol=0.01
    )
    off = np.abs(spacings[-499:] - np.median(spacings[-499:])) / 1e3
    np.testing.assert_allclose(recent.jitter_p99, np.percentile(off, 99), rtol=0.05)
    np.testing.assert_allclose(ever.p99, np.percentile(latencies, 99) / 1e3, rtol=0.04)
    assert ever.largest == max(latencies) / 1e3
    # 50 us of jitter on 2 ms are as much as a bin is wide.
    assert 0 <= ever.jitter_p99 < 150
    counts = timing.histograms()
    assert counts.shape == (2, BINS)
    assert counts.sum(axis=1).tolist() == [6000, 5999]
