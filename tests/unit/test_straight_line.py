"""Straight lines through exponentially weighted estimates: no lag, correct errors, innovations."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.tracking.live_registration import DoubleExponentialSmoother

MEMORY_S = 8.0
KEEP = float(np.exp(-1 / MEMORY_S))
SIGMA = 0.3


def follow(truth, noise, *, fastest=0.5, static=0.0, durations=None):
    """What comes of a run of updates: estimates are the faded means of truth and noise.

    Without ``durations`` an update takes a second.
    """
    line = DoubleExponentialSmoother(MEMORY_S, np.array([fastest]))
    weight = total = squares = 0.0
    found = []
    for value, seconds in zip(truth + noise, durations or np.ones(len(truth)), strict=True):
        keep = KEEP**seconds
        weight, total, squares = (
            keep * weight + seconds,
            keep * total + seconds * value,
            keep**2 * squares + seconds,
        )
        mean, variance = np.array([total / weight]), np.array([[SIGMA**2 * squares / weight**2]])
        found.append(line.update(mean, variance, np.array([[static]]), seconds))
    return found


def test_a_line_is_followed_without_lag():
    # Updates hold the mean over their second, and the true values now is half a second later.
    truth = 0.2 * (np.arange(60) + 0.5)
    found = follow(truth, np.zeros(60))
    errors = np.array([one.value[0] for one in found]) - 0.2 * (np.arange(60) + 1.0)
    assert np.abs(errors[10:]).max() < 0.02
    assert found[-1].rate[0] == pytest.approx(0.2, rel=0.02)
    # The faded mean itself lags by its memory.
    assert 0.2 * 8 * 0.9 < 0.2 * 60 - np.average(truth, weights=KEEP ** np.arange(60)[::-1]) < 0.2 * 9


def test_updates_of_different_durations_follow_the_same_line_with_correct_errors():
    rng = np.random.default_rng(8)
    pulls = []
    for _ in range(200):
        durations = rng.choice([0.5, 1.0, 3.0], 20).tolist()
        ends = np.cumsum(durations)
        truth, noise = (
            0.2 * (ends - np.array(durations) / 2),
            SIGMA * rng.standard_normal(20) / np.sqrt(durations),
        )
        calm, last = (
            follow(truth, 0 * noise, durations=durations)[-1],
            follow(truth, noise, durations=durations)[-1],
        )
        assert abs(calm.value[0] - 0.2 * ends[-1]) < 0.05
        pulls.append((last.value[0] - 0.2 * ends[-1]) / np.sqrt(last.covariance[0, 0]))
    assert 0.5 < np.mean(np.square(pulls)) < 1.3


@pytest.mark.parametrize("rate", [0.0, 0.3])
@pytest.mark.parametrize("at", [2, 6, 40])
def test_errors_are_correct_while_the_memory_fills_and_after(rate, at):
    rng = np.random.default_rng(7)
    pulls = []
    for _ in range(200):
        truth = rate * (np.arange(at + 1) + 0.5)
        last = follow(truth, SIGMA * rng.standard_normal(at + 1))[-1]
        pulls.append((last.value[0] - rate * (at + 1)) / np.sqrt(last.covariance[0, 0]))
    # 200 draws know the mean square to 10 %; the drift is assumed to have any rate up to the fastest.
    assert 0.5 < np.mean(np.square(pulls)) < 1.3


def test_what_does_not_change_is_not_averaged_away():
    last = follow(np.zeros(80), np.zeros(80), static=0.04)[-1]
    assert last.covariance[0, 0] == pytest.approx(0.04 + last.random_covariance[0, 0])
    assert last.random_covariance[0, 0] < 0.03


def test_a_jump_has_a_large_innovation_and_noise_has_none():
    rng = np.random.default_rng(3)
    truth = np.zeros(50)
    truth[40:] = 10.0
    found = follow(truth, SIGMA * rng.standard_normal(50))
    innovations = np.array([abs(one.innovation[0]) for one in found])
    assert innovations[:40].max() < 4
    assert innovations[40] > 10


def test_errors_cover_what_bends_within_the_memory():
    rng = np.random.default_rng(9)
    t = np.arange(120)
    pulls = []
    for _ in range(20):
        phase = rng.uniform(0, 2 * np.pi)
        truth = 1.5 * np.sin(2 * np.pi * (t + 0.5) / 48 + phase)
        found = follow(truth, SIGMA * rng.standard_normal(120))
        now = 1.5 * np.sin(2 * np.pi * (t + 1.0) / 48 + phase)
        pulls += [
            (one.value[0] - v) / np.sqrt(one.covariance[0, 0])
            for one, v in zip(found[20:], now[20:], strict=True)
        ]
    assert 0.5 < np.mean(np.square(pulls)) < 2.0


def test_what_bends_too_fast_widens_the_errors():
    t = np.arange(60) + 0.5
    swing = 5 * np.sin(2 * np.pi * t / 20)
    calm, wild = follow(np.zeros(60), np.zeros(60), fastest=0.1), follow(swing, np.zeros(60), fastest=0.1)
    assert wild[-1].random_covariance[0, 0] > 4 * calm[-1].random_covariance[0, 0]


def test_a_restart_forgets():
    line = DoubleExponentialSmoother(MEMORY_S, np.array([0.1]))
    one = np.eye(1)
    for value in (1.0, 2.0, 3.0):
        line.update(np.array([value]), 0.01 * one, 0 * one)
    line.restart()
    again = line.update(np.array([9.0]), 0.01 * one, 0 * one)
    assert again.value[0] == 9.0
    assert again.rate[0] == 0.0


def test_scatter_beyond_the_noise_is_no_jump_from_the_first_update_on():
    # As on a pyramid, whose response varies with the wavefronts of a second.
    rng = np.random.default_rng(12)
    innovations = [
        max(abs(one.innovation[0]) for one in follow(np.zeros(30), 6 * SIGMA * rng.standard_normal(30)))
        for _ in range(100)
    ]
    assert max(innovations) < 8


def test_a_jump_in_the_seventh_second_is_one():
    rng = np.random.default_rng(4)
    truth = np.zeros(10)
    truth[6:] = 10.0
    found = follow(truth, SIGMA * rng.standard_normal(10))
    assert abs(found[6].innovation[0]) > 10
