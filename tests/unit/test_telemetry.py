"""Slopes and pokes on one time line: a lost frame removes its pairs and shifts none."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.acquisition.aligned_telemetry import AlignedBuffer, AlignedTelemetry


def recorder(index, rows=100, n_slopes=3, n_modes=2):
    """Rows that carry their own index."""
    r = AlignedBuffer(n_slopes, n_modes, rows)
    for k, i in enumerate(index):
        for _ in range(i - index[k - 1] - 1 if k else 0):
            r.append_lost()
        assert r.append_one(np.full(n_slopes, i, np.float32), np.full(n_modes, 10.0 * i)) == rows - r.n_filled
    return r


def stretch(index):
    return recorder(index).telemetry()


def test_rows_stand_at_their_index():
    t = stretch([5, 6, 8, 11])
    assert t.present.tolist() == [True, True, False, True, False, False, True]
    assert t.slopes[:, 0].tolist() == [5, 6, 0, 8, 0, 0, 11]
    assert t.slopes.shape == (7, 3)
    assert t.pokes.shape == (7, 2)


def test_while_a_frame_is_lost_the_last_poke_stays():
    assert stretch([5, 6, 8, 11]).pokes[:, 0].tolist() == [50, 60, 60, 80, 80, 80, 110]


def test_nothing_is_a_stretch_too():
    empty = stretch([])
    assert empty.slopes.shape == (0, 3)
    assert empty.find_complete_rows(2, 3).size == 0


@pytest.mark.parametrize(("past", "lags"), [(0, 1), (2, 1), (0, 3), (2, 4)])
@pytest.mark.parametrize("lost", [0.0, 0.15])
def test_complete_rows_are_those_with_all_they_need(past, lags, lost):
    rng = np.random.default_rng(0)
    t = stretch(np.flatnonzero(rng.random(80) >= lost))
    want = [
        k
        for k in range(past + lags - 1, t.present.size)
        # The pokes before are known on lost frames too; only slopes can be missing.
        if all(t.present[k - j] for j in range(past + 1))
    ]
    assert t.find_complete_rows(past, lags).tolist() == want
    assert 0 < len(want) <= 80


def test_many_frames_at_once_are_many_single_ones():
    slopes, pokes = np.arange(12.0).reshape(4, 3), np.arange(8.0).reshape(4, 2)
    one, many = AlignedBuffer(3, 2, 3), AlignedBuffer(3, 2, 3)
    assert [one.append_one(s, p) for s, p in zip(slopes[:3], pokes[:3], strict=True)] == [2, 1, 0]
    assert many.append(slopes, pokes) == 3
    assert one.is_full
    assert many.is_full
    assert np.array_equal(one.telemetry().rows, many.telemetry().rows)
    assert np.array_equal(many.telemetry().pokes, pokes[:3])


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize("where", ["slopes", "poke"])
def test_a_frame_that_is_not_finite_is_not_taken(bad, where):
    r = recorder([0, 1])
    slopes, poke = np.ones(3, np.float32), np.ones(2)
    (slopes if where == "slopes" else poke)[1] = bad
    assert r.append_one(slopes, poke) == -1
    assert r.n_filled == 2
    assert r.append_one(np.full(3, 2, np.float32), np.full(2, 20.0)) > 0
    assert np.array_equal(r.telemetry().rows, stretch([0, 1, 2]).rows)


def test_what_is_kept_is_the_past_of_what_follows():
    index = [0, 1, 3, 4]
    r = recorder(index, rows=6)
    assert r.n_new == 4
    r.retain_last(3)
    assert (r.n_filled, r.n_retained, r.n_new) == (3, 3, 0)
    for i in (5, 6, 7):
        assert r.append_one(np.full(3, i, np.float32), np.full(2, 10.0 * i)) == 7 - i
    assert r.n_new == 3
    t = r.telemetry()
    assert t.slopes[:, 0].tolist() == [0, 3, 4, 5, 6, 7]
    assert t.pokes[:, 0].tolist() == [10, 30, 40, 50, 60, 70]
    assert t.present.tolist() == [False, True, True, True, True, True]
    r.retain_last(99)
    assert r.n_filled == 6
    assert r.n_new == 0


@pytest.mark.parametrize("rows", [4, 9])
def test_another_size_changes_nothing_that_is_there(rows):
    r = recorder([0, 1, 3], rows=6)
    before = r.telemetry()
    r.resize(rows)
    after = r.telemetry()
    assert np.array_equal(after.rows, before.rows)
    assert np.array_equal(after.present, before.present)
    room = rows - 4
    assert r.is_full == (room == 0)
    for k in range(room):
        assert r.append_one(np.ones(3, np.float32), np.ones(2)) == room - k - 1
    assert r.telemetry().present.tolist() == [True, True, False, True] + [True] * room


@pytest.mark.parametrize(("limit", "kept"), [(100, 10), (10, 10), (5, 5), (4, 4), (3, 3), (1, 1)])
def test_thinning_keeps_at_most_so_many_slopes(limit, kept):
    rng = np.random.default_rng(1)
    t = AlignedTelemetry(rng.standard_normal((4, 11)).astype(np.float32), np.ones(4, bool), 10)
    thin = t.select_slopes(limit)
    assert 0 < thin.slopes.shape[1] <= kept
    assert np.isin(thin.slopes, t.slopes).all()
    assert np.array_equal(thin.pokes, t.pokes)
