"""Records slopes and commands of a closed loop."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.callbacks import Callbacks
from escape_hw.api.camera import Frame
from escape_hw.io.fits.telemetry import LoopTelemetry


class LoopTelemetryRecorder:
    """Keeps slopes and commands of the last ``frames`` frames in memory.

    A frame without a command of its own is stored with the command before it.
    """

    def __init__(self, frames: int, n_slopes: int, n_act: int) -> None:
        self._index = np.zeros(frames, np.int64)
        self._exposed_ns = np.zeros(frames, np.int64)
        self._slopes = np.zeros((frames, n_slopes), np.float32)
        self._commands = np.zeros((frames, n_act))
        self._rows, self._n_recorded, self._newest_ns = frames, 0, 0
        self._command_pending = False

    @property
    def callbacks(self) -> Callbacks:
        """Callbacks to set on the bench before the loop is closed."""
        return Callbacks(frame=self._frame, slopes=self._frame_slopes, command=self._command)

    def _frame(self, frame: Frame) -> None:
        self._newest_ns = frame.exposed_ns

    def _frame_slopes(self, index: int, slopes: NDArray[np.float32]) -> None:
        if slopes.size != self._slopes.shape[1]:
            # Slopes of another geometry (a sensor set-up) do not belong to the loop.
            return
        row, before = self._n_recorded % self._rows, (self._n_recorded - 1) % self._rows
        self._index[row], self._exposed_ns[row], self._slopes[row] = index, self._newest_ns, slopes
        self._commands[row] = self._commands[before]
        self._n_recorded += 1
        self._command_pending = True

    def _command(self, command: NDArray[np.float64]) -> None:
        # The first command after a frame belongs to it; further ones flatten the mirror.
        if self._command_pending:
            self._commands[(self._n_recorded - 1) % self._rows] = command
            self._command_pending = False

    def to_telemetry(self) -> LoopTelemetry:
        """The recorded frames, oldest first; only those since the camera last restarted its frame index."""
        n = min(self._n_recorded, self._rows)
        order = (np.arange(self._n_recorded - n, self._n_recorded)) % self._rows
        restarts = np.flatnonzero(np.diff(self._index[order]) <= 0)
        order = order[restarts[-1] + 1 :] if restarts.size else order
        exposed = self._exposed_ns[order]
        return LoopTelemetry(
            self._index[order],
            np.asarray((exposed - exposed[:1]) * 1e-9, np.float64),
            self._slopes[order],
            self._commands[order],
        )
