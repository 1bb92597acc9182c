"""An estimator beside a running loop: frames are handed over in blocks, the sums are another thread's."""

from __future__ import annotations

import contextlib
import os
import queue
import threading
from collections.abc import Callable
from typing import Self

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.acquisition.frames import SlopeStatistics
from escape_hw.calibration.docrime.estimator import DocrimeEstimator

#: Frames handed over at once.
BLOCK = 100
#: Blocks that may wait.
_MAX_QUEUED_BLOCKS = 8
#: How much less urgent the sums are than the loop (Unix: nice).
_NICE_INCREMENT = 10


class EstimatorThread:
    """Feeds a closed-loop estimator from a loop that must not wait for it; use it in ``with``.

    The loop's thread copies a frame's numbers into a buffer and no more. Matrix products run in
    another thread, and they hold no interpreter lock.

    Parameters
    ----------
    estimator
        Takes slopes with commands and pokes beside them. Nobody else touches it before :meth:`finish`.
    patient
        Whether the loop waits when the sums are :data:`_MAX_QUEUED_BLOCKS` blocks behind; otherwise these
        frames are lost to the estimate, and counted.
    look
        Called in the other thread after each block, with the estimator.

    Attributes
    ----------
    motion
        Of the slopes in the estimate.
    skipped
        Frames lost because the sums were behind.
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
        self._free_blocks: queue.SimpleQueue[tuple[NDArray[np.int64], NDArray[np.float32]]] = (
            queue.SimpleQueue()
        )
        for _ in range(_MAX_QUEUED_BLOCKS + 1):
            self._free_blocks.put((np.zeros(BLOCK, np.int64), np.zeros((BLOCK, columns), np.float32)))
        self._filled_blocks: queue.Queue[tuple[NDArray[np.int64], NDArray[np.float32], int] | None] = (
            queue.Queue()
        )
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
        self,
        index: int,
        slopes: NDArray[np.float32],
        command: NDArray[np.float64],
        poke: NDArray[np.float64],
    ) -> None:
        """Take one frame, as a loop's observer.

        Raises
        ------
        Exception
            What the estimator raised in its thread.
        """
        k, n, m = self._n_filled, self._n_slopes, self._n_modes
        row = self._rows[k]
        row[:n], row[n : n + m], row[n + m :] = slopes, command, poke
        self._index[k] = index
        self._n_filled = k + 1
        if self._n_filled == BLOCK:
            self._submit_block()

    def wait_until_summed(self) -> None:
        """Wait until all whole blocks are in the sums, if the loop may wait at all."""
        if self._blocking:
            self._filled_blocks.join()

    def finish(self) -> DocrimeEstimator:
        """Wait for the sums; the estimator with all frames in it.

        Raises
        ------
        Exception
            What the estimator raised in its thread.
        """
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
            # The estimator sees a gap in the index, as of frames that the camera lost.
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
        if hasattr(os, "setpriority"):
            # Threads have priorities of their own on Linux only.
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE_INCREMENT)
        while (block := self._filled_blocks.get()) is not None:
            index, rows, filled = block
            try:
                if self._error is None:
                    part = rows[:filled]
                    n = self._n_slopes
                    self.estimator.extend(index[:filled], part[:, :n], part[:, n:])
                    self.slope_statistics.extend(part[:, :n])
                    if self._on_block is not None:
                        self._on_block(self.estimator)
            except BaseException as error:
                # The loop's thread raises it at its next block.
                self._error = error
            finally:
                self._free_blocks.put((index, rows))
                self._filled_blocks.task_done()
