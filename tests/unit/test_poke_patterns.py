"""Sequences of pokes: amplitudes, order and correlation."""

from __future__ import annotations

import numpy as np

from escape_hw.calibration.acquisition.pokes import PushPullPokes, RandomPokes

AMPLITUDE = np.array([0.01, 0.02, 0.03, 0.04])


def test_random_pokes_are_uniform_and_independent():
    pokes = RandomPokes(AMPLITUDE, np.random.default_rng(0))
    drawn = np.array([pokes() for _ in range(4000)]) / AMPLITUDE
    assert np.abs(drawn).max() <= 1
    assert np.abs(drawn.std(axis=0) - 1 / np.sqrt(3)).max() < 0.02
    together = np.corrcoef(drawn.T)
    assert np.abs(together - np.eye(4)).max() < 0.08
    assert abs(np.corrcoef(drawn[:-1, 0], drawn[1:, 0])[0, 1]) < 0.08


def test_push_pull_takes_one_mode_at_a_time_and_every_mode_once_a_round():
    pokes = PushPullPokes(AMPLITUDE, np.random.default_rng(0))
    drawn = np.array([pokes().copy() for _ in range(8 * 50)])
    assert (np.count_nonzero(drawn, axis=1) == 1).all()
    np.testing.assert_allclose(drawn[0::2], -drawn[1::2])
    rounds = drawn.reshape(50, 8, 4)
    np.testing.assert_allclose(np.abs(rounds).sum(axis=1), np.tile(2 * AMPLITUDE, (50, 1)))
    first = np.abs(rounds[:, 0]).argmax(axis=1)
    assert set(first) == {0, 1, 2, 3}
    signs = np.sign(drawn[0::2].sum(axis=1))
    assert abs(signs.mean()) < 0.25
