"""Runs a DO-CRIME estimator in a thread beside a closed loop."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics
from escape_hw.calibration.docrime.estimator import DocrimeEstimator

#: Frames of a block that is passed to the thread.
BLOCK = 100
#: Largest number of blocks in the queue.
_MAX_QUEUED_BLOCKS = 8
#: Increment of the thread's nice value: the loop has priority.
_NICE_INCREMENT = 10


class EstimatorThread:
    """Passes the frames of a loop to an estimator in another thread; an observer and a context manager.

    The loop's thread only copies each frame into a buffer. The matrix products of the other thread release
    the interpreter lock.

    Parameters
    ----------
    estimator
        A closed-loop estimator; not to be used elsewhere before :meth:`finish`.
    blocking
        Whether the loop waits while the queue is full; otherwise the frames of a block are skipped and
        counted.
    on_block
        Called with the estimator after each block, in the estimator's thread.

    Attributes
    ----------
    skipped
        Number of frames skipped because the queue was full.
    """

    def __init__(
        self,
        estimator: DocrimeEstimator,
        *,
        blocking: bool,
        on_block: Callable[[DocrimeEstimator], None] | None = None,
    ) -> None:
        self.estimator, self.skipped, self._blocking, self._on_block = estimator, 0, blocking, on_block
        self._n_slopes, self._n_modes = estimator.n_slopes, estimator.n_modes
        self.slope_statistics = SlopeStatistics(estimator.n_slopes)
        columns = self._n_slopes + 2 * self._n_modes
        self._free_blocks = queue.SimpleQueue[tuple[NDArray[np.int64], NDArray[np.float32]]]()
        for _ in range(_MAX_QUEUED_BLOCKS + 1):
            self._free_blocks.put((np.zeros(BLOCK, np.int64), np.zeros((BLOCK, columns), np.float32)))
        self._filled_blocks = queue.Queue[tuple[NDArray[np.int64], NDArray[np.float32], int] | None]()
        self._index, self._rows = self._free_blocks.get()
        self._n_filled = 0
        self._error: BaseException | None = None
        self._thread = threading.Thread(target=self._process_blocks, name="estimator", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop_thread()

    def __call__(
        self, index: int, slopes: NDArray[np.float32], command: NDArray[np.float64], poke: NDArray[np.float64]
    ) -> None:
        """Add one frame, as an observer of the loop; raises an exception of the estimator's thread."""
        k, n, m = self._n_filled, self._n_slopes, self._n_modes
        row = self._rows[k]
        row[:n], row[n : n + m], row[n + m :] = slopes, command, poke
        self._index[k] = index
        self._n_filled = k + 1
        if self._n_filled == BLOCK:
            self._submit_block()

    def wait_until_summed(self) -> None:
        """Wait until all complete blocks are in the sums, if ``blocking``."""
        if self._blocking:
            self._filled_blocks.join()

    def finish(self) -> DocrimeEstimator:
        """Wait for the thread and return the estimator; raises an exception of the estimator's thread."""
        if self._n_filled:
            self._filled_blocks.put((self._index, self._rows, self._n_filled))
            self._n_filled = 0
        self._stop_thread()
        if self._error is not None:
            raise self._error
        return self.estimator

    def _submit_block(self) -> None:
        if self._error is not None:
            raise self._error
        if not self._blocking and self._free_blocks.empty():
            # The estimator treats the gap in the index like frames that the camera lost.
            self.skipped += self._n_filled
        else:
            self._filled_blocks.put((self._index, self._rows, self._n_filled))
            self._index, self._rows = self._free_blocks.get()
        self._n_filled = 0

    def _stop_thread(self) -> None:
        if self._thread.is_alive():
            self._filled_blocks.put(None)
            self._thread.join()

    def _process_blocks(self) -> None:
        with contextlib.suppress(OSError):
            # Linux accepts a thread id here.
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE_INCREMENT)
        while (block := self._filled_blocks.get()) is not None:
            index, rows, filled = block
            try:
                if self._error is None:
                    slopes, excitation = np.split(rows[:filled], [self._n_slopes], axis=1)
                    self.estimator.extend(index[:filled], slopes, excitation)
                    self.slope_statistics.extend(slopes)
                    if self._on_block is not None:
                        self._on_block(self.estimator)
            except BaseException as error:
                # Raised in the loop's thread with its next block.
                self._error = error
            finally:
                self._free_blocks.put((index, rows))
                self._filled_blocks.task_done()
