"""Records the newest frames of a running loop through a bench's taps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.frames import Frame
from escape_hw.api.taps import Taps
from escape_hw.io.telemetry import LoopTelemetry


class TelemetryTape:
    """Keeps slopes and commands of the newest frames; one that was not answered keeps the command before.

    Parameters
    ----------
    frames
        How many.
    n_slopes, n_act
        Sizes.
    """

    def __init__(self, frames: int, n_slopes: int, n_act: int) -> None:
        self._index = np.zeros(frames, np.int64)
        self._exposed_ns = np.zeros(frames, np.int64)
        self._slopes = np.zeros((frames, n_slopes), np.float32)
        self._commands = np.zeros((frames, n_act))
        self._rows, self._taken, self._newest_ns = frames, 0, 0
        self._awaited = False

    @property
    def taps(self) -> Taps:
        """What to set as the bench's taps before anything runs."""
        return Taps(frame=self._frame, slopes=self._frame_slopes, command=self._command)

    def _frame(self, frame: Frame) -> None:
        self._newest_ns = frame.exposed_ns

    def _frame_slopes(self, index: int, slopes: NDArray[np.float32]) -> None:
        if slopes.size != self._slopes.shape[1]:
            # A look at the sensor with another geometry is no part of the loop.
            return
        row, before = self._taken % self._rows, (self._taken - 1) % self._rows
        self._index[row], self._exposed_ns[row], self._slopes[row] = index, self._newest_ns, slopes
        self._commands[row] = self._commands[before]
        self._taken += 1
        self._awaited = True

    def _command(self, command: NDArray[np.float64]) -> None:
        # Only the first answers the frame: what comes without a frame between flattens the mirror.
        if self._awaited:
            self._commands[(self._taken - 1) % self._rows] = command
            self._awaited = False

    def telemetry(self) -> LoopTelemetry:
        """A copy of what was recorded, oldest first, from the last start of the camera's numbers on."""
        n = min(self._taken, self._rows)
        order = (np.arange(self._taken - n, self._taken)) % self._rows
        falls = np.flatnonzero(np.diff(self._index[order]) <= 0)
        order = order[falls[-1] + 1 :] if falls.size else order
        exposed = self._exposed_ns[order]
        return LoopTelemetry(
            self._index[order],
            np.asarray((exposed - exposed[:1]) * 1e-9, np.float64),
            self._slopes[order],
            self._commands[order],
        )
