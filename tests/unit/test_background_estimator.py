"""The estimator in a background thread: every frame once and in order, errors raised."""

from __future__ import annotations

import threading

import numpy as np
import pytest

from escape_hw.calibration.docrime import estimator_thread as background
from escape_hw.calibration.docrime.estimator_thread import EstimatorThread

N_SLOPES, N_MODES = 4, 2


class Recorder:
    """Stands for an estimator; remembers what it was given and may be held up or fail."""

    n_slopes, n_modes = N_SLOPES, N_MODES

    def __init__(self):
        self.index, self.rows, self.go, self.error = [], [], threading.Event(), None
        self.go.set()

    def extend(self, index, slopes, excitation):
        self.go.wait(10)
        if self.error is not None:
            raise self.error
        self.index += index.tolist()
        self.rows += np.concatenate([slopes, excitation], axis=1).tolist()


def feed(beside, frames, first=0):
    for k in range(first, first + frames):
        beside(k, np.full(N_SLOPES, k, np.float32), np.full(N_MODES, k + 0.25), np.full(N_MODES, k + 0.5))


@pytest.mark.parametrize("frames", [0, 1, 99, 100, 101, 1234])
def test_every_frame_arrives_once_and_in_order(frames):
    looked = []
    recorder = Recorder()
    with EstimatorThread(recorder, blocking=True, on_block=lambda e: looked.append(len(e.index))) as beside:
        feed(beside, frames)
        assert beside.finish() is recorder
    assert recorder.index == list(range(frames))
    assert recorder.rows == [[k] * N_SLOPES + [k + 0.25] * 2 + [k + 0.5] * 2 for k in range(frames)]
    if frames > 1:
        slope_statistics = beside.slope_statistics.state()
        assert slope_statistics[0] == pytest.approx(np.sum(np.arange(frames)))
        assert slope_statistics[1] == pytest.approx(np.sum(np.square(np.arange(frames))), rel=1e-5)
    assert len(looked) == -(-frames // background.BLOCK)
    assert beside.skipped == 0


def test_a_waiting_loop_skips_no_block_and_another_skips_whole_blocks():
    recorder = Recorder()
    recorder.go.clear()
    with EstimatorThread(recorder, blocking=False) as beside:
        feed(beside, 40 * background.BLOCK)
        recorder.go.set()
        beside.finish()
    assert beside.skipped > 20 * background.BLOCK
    assert beside.skipped % background.BLOCK == 0
    assert len(recorder.index) + beside.skipped == 40 * background.BLOCK
    assert recorder.index == sorted(recorder.index)
    slow = Recorder()
    slow.go.clear()
    with EstimatorThread(slow, blocking=True) as beside:
        threading.Timer(0.05, slow.go.set).start()
        feed(beside, 40 * background.BLOCK)
        beside.wait_until_summed()
        assert len(slow.index) == 40 * background.BLOCK
    assert beside.skipped == 0


def test_an_error_of_the_estimator_reaches_the_loop():
    recorder = Recorder()
    recorder.error = ValueError("not finite")
    with EstimatorThread(recorder, blocking=True) as beside:
        feed(beside, 2 * background.BLOCK - 1)
        beside.wait_until_summed()
        with pytest.raises(ValueError, match="not finite"):
            feed(beside, 1, 2 * background.BLOCK - 1)
    with EstimatorThread(recorder, blocking=True) as beside:
        feed(beside, 5)
        with pytest.raises(ValueError, match="not finite"):
            beside.finish()
    assert not [t for t in threading.enumerate() if t.name == "estimator"]
