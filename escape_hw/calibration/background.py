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

from escape_hw.calibration.acquire import Motion
from escape_hw.calibration.docrime_estimator import DocrimeEstimator

#: Frames handed over at once.
BLOCK = 100
#: Blocks that may wait.
_WAITING = 8
#: How much less urgent the sums are than the loop (Unix: nice).
_NICE = 10


class BackgroundEstimator:
    """Feeds a closed-loop estimator from a loop that must not wait for it; use it in ``with``.

    The loop's thread copies a frame's numbers into a buffer and no more. Matrix products run in
    another thread, and they hold no interpreter lock.

    Parameters
    ----------
    estimator
        Takes slopes with commands and pokes beside them. Nobody else touches it before :meth:`finish`.
    patient
        Whether the loop waits when the sums are :data:`_WAITING` blocks behind; otherwise these
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
        patient: bool,
        look: Callable[[DocrimeEstimator], None] | None = None,
    ) -> None:
        self.estimator, self.skipped, self._patient, self._look = estimator, 0, patient, look
        self._n_slopes, self._n_modes = estimator.n_slopes, estimator.n_modes
        self.motion = Motion(estimator.n_slopes)
        columns = self._n_slopes + 2 * self._n_modes
        self._free: queue.SimpleQueue[tuple[NDArray[np.int64], NDArray[np.float32]]] = queue.SimpleQueue()
        for _ in range(_WAITING + 1):
            self._free.put((np.zeros(BLOCK, np.int64), np.zeros((BLOCK, columns), np.float32)))
        self._full: queue.Queue[tuple[NDArray[np.int64], NDArray[np.float32], int] | None] = queue.Queue()
        self._index, self._rows = self._free.get()
        self._filled = 0
        self._failed: BaseException | None = None
        self._thread = threading.Thread(target=self._work, name="estimator", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._close()

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
        k, n, m = self._filled, self._n_slopes, self._n_modes
        row = self._rows[k]
        row[:n], row[n : n + m], row[n + m :] = slopes, command, poke
        self._index[k] = index
        self._filled = k + 1
        if self._filled == BLOCK:
            self._hand_over()

    def catch_up(self) -> None:
        """Wait until all whole blocks are in the sums, if the loop may wait at all."""
        if self._patient:
            self._full.join()

    def finish(self) -> DocrimeEstimator:
        """Wait for the sums; the estimator with all frames in it.

        Raises
        ------
        Exception
            What the estimator raised in its thread.
        """
        if self._filled:
            self._full.put((self._index, self._rows, self._filled))
            self._filled = 0
        self._close()
        if self._failed is not None:
            raise self._failed
        return self.estimator

    def _hand_over(self) -> None:
        if self._failed is not None:
            raise self._failed
        if not self._patient and self._free.empty():
            # The estimator sees a gap in the index, as of frames that the camera lost.
            self.skipped += self._filled
        else:
            self._full.put((self._index, self._rows, self._filled))
            self._index, self._rows = self._free.get()
        self._filled = 0

    def _close(self) -> None:
        if self._thread.is_alive():
            self._full.put(None)
            self._thread.join()

    def _work(self) -> None:
        if hasattr(os, "setpriority"):
            # Threads have priorities of their own on Linux only.
            with contextlib.suppress(OSError):
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), _NICE)
        while (block := self._full.get()) is not None:
            index, rows, filled = block
            try:
                if self._failed is None:
                    part = rows[:filled]
                    n = self._n_slopes
                    self.estimator.extend(index[:filled], part[:, :n], part[:, n:])
                    self.motion.extend(part[:, :n])
                    if self._look is not None:
                        self._look(self.estimator)
            except BaseException as error:
                # The loop's thread raises it at its next block.
                self._failed = error
            finally:
                self._free.put((index, rows))
                self._full.task_done()
