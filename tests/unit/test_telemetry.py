"""Slopes and pokes on one time line: a lost frame loses its pairs and shifts none."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.telemetry import Telemetry


def stretch(index, n_slopes=3, n_modes=2):
    """Rows that carry their own index."""
    index = np.asarray(index, np.int64)
    slopes = np.repeat(index[:, None], n_slopes, 1).astype(np.float32)
    return Telemetry.from_frames(index, slopes, np.repeat(10.0 * index[:, None], n_modes, 1))


def test_rows_stand_at_their_index():
    t = stretch([5, 6, 8, 11])
    assert t.present.tolist() == [True, True, False, True, False, False, True]
    assert t.slopes[:, 0].tolist() == [5, 6, 0, 8, 0, 0, 11]
    assert t.n_lost == 3


def test_while_a_frame_is_lost_the_last_poke_stays():
    assert stretch([5, 6, 8, 11]).pokes[:, 0].tolist() == [50, 60, 60, 80, 80, 80, 110]


def test_single_precision_pokes_stay_single():
    pokes = np.zeros((2, 1), np.float32)
    assert Telemetry.from_frames(np.arange(2), np.zeros((2, 1), np.float32), pokes).pokes.dtype == np.float32


@pytest.mark.parametrize("index", [[3, 3], [4, 2], [1, 2, 3, 3, 4]])
def test_an_index_that_does_not_rise_is_refused(index):
    with pytest.raises(ValueError, match="must rise"):
        stretch(index)


def test_nothing_is_a_stretch_too():
    empty = stretch([])
    assert empty.slopes.shape == (0, 3)
    assert empty.n_lost == 0
    assert empty.complete(2, 3).size == 0


@pytest.mark.parametrize(("past", "lags"), [(0, 1), (2, 1), (0, 3), (2, 4)])
def test_complete_rows_are_those_with_all_they_need(past, lags):
    rng = np.random.default_rng(0)
    t = stretch(np.flatnonzero(rng.random(80) > 0.15))
    want = [
        k
        for k in range(past + lags - 1, t.present.size)
        # The pokes before are known on lost frames too; only slopes can be missing.
        if all(t.present[k - j] for j in range(past + 1))
    ]
    assert t.complete(past, lags).tolist() == want
    assert 0 < len(want) < 80


@pytest.mark.parametrize("cut", [1, 4, 9])
def test_two_stretches_make_one(cut):
    index = np.array([0, 1, 2, 4, 5, 9, 10, 11, 12, 15])
    whole = stretch(index)
    first, second = stretch(index[:cut]), stretch(index[cut:])
    joined = first.followed_by(second, int(index[cut] - index[cut - 1] - 1))
    for name in ("slopes", "pokes", "present"):
        assert np.array_equal(getattr(joined, name), getattr(whole, name))


def test_the_tail_is_the_last_rows():
    t = stretch([0, 1, 3, 4])
    assert t.tail(2).slopes[:, 0].tolist() == [3, 4]
    assert t.tail(3).present.tolist() == [False, True, True]
    assert t.tail(99).slopes.shape == t.slopes.shape


@pytest.mark.parametrize(("limit", "kept"), [(100, 10), (10, 10), (5, 5), (4, 4), (3, 3), (1, 1)])
def test_thinning_keeps_at_most_so_many_slopes(limit, kept):
    rng = np.random.default_rng(1)
    t = Telemetry.from_frames(np.arange(4), rng.standard_normal((4, 10)).astype(np.float32), np.zeros((4, 1)))
    thin = t.thinned(limit)
    assert 0 < thin.slopes.shape[1] <= kept
    assert np.isin(thin.slopes, t.slopes).all()
    assert np.array_equal(thin.pokes, t.pokes)
