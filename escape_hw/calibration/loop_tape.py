"""Slopes, commands and pokes of a running loop, gathered on their time line and handed over in blocks."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.telemetry import Recorder, Telemetry


class LoopTape:
    """Observer of a running loop.

    Parameters
    ----------
    n_slopes, n_modes
        Sizes.
    rows
        Frames of a block.
    past
        Rows that each block repeats of the one before it: the past of its first frames.
    """

    def __init__(self, n_slopes: int, n_modes: int, rows: int, past: int) -> None:
        self._recorder = Recorder(n_slopes, n_modes, rows + past, closed=True)
        self._moves, self._n_modes, self._past = np.zeros(2 * n_modes), n_modes, past
        self._next: int | None = None
        self.frames = self.lost = 0

    def __call__(
        self, index: int, slopes: NDArray[np.float32], command: NDArray[np.float64], poke: NDArray[np.float64]
    ) -> None:
        """Take a frame; see :data:`~escape_hw.calibration.loop_run.LoopObserver`.

        Raises
        ------
        ValueError
            The slopes are not finite.
        """
        gap = 0 if self._next is None else index - self._next
        self._next = index + 1
        self.lost += gap
        for _ in range(min(gap, 2 * self._past)):
            self._room()
            self._recorder.lose_one()
        self._room()
        self._moves[: self._n_modes], self._moves[self._n_modes :] = command, poke
        if self._recorder.take_one(slopes, self._moves) < 0:
            raise ValueError(f"frame {index}: slopes or commands are not finite")
        self.frames += 1

    def _room(self) -> None:
        if self._recorder.full:
            # Whoever works the blocks off is late.
            self._recorder.resize(2 * self._recorder.filled)

    def handover(self) -> tuple[Telemetry, int]:
        """A copy of the rows gathered, and the first of them that was not handed over before."""
        data, start = self._recorder.telemetry(), self._recorder.kept
        block = Telemetry(data.rows.copy(), data.present.copy(), data.n_slopes, data.closed)
        self._recorder.keep(self._past)
        return block, start

    def rewind(self) -> None:
        """Forget what was gathered."""
        self._recorder.keep(0)
        self._next = None
