"""Slopes, commands and pokes paired by camera frame index, and buffers that collect them.

Gaps in the index remove pairs; ``docrime.estimator`` and ``sprint.telemetry_fit`` use the index the same way.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from math import isfinite

import numpy as np
from numpy.typing import NDArray


class TelemetryRows:
    """Slopes and commands side by side, and in closed loop the pokes; one row per frame."""

    rows: NDArray[np.float32]
    n_slopes: int
    closed: bool

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return int(self.rows.shape[1] - self.n_slopes) // (2 if self.closed else 1)

    @property
    def commands(self) -> NDArray[np.float32]:
        """``(n_times, n_modes)``; in closed loop the sum of controller and poke."""
        return self.rows[:, self.n_slopes : self.n_slopes + self.n_modes]

    @property
    def pokes(self) -> NDArray[np.float32]:
        """``(n_times, n_modes)``; in open loop these are the commands."""
        return self.rows[:, self.rows.shape[1] - self.n_modes :]


@dataclass(frozen=True, slots=True, eq=False)
class AlignedTelemetry(TelemetryRows):
    """A stretch of a run, one row per frame index, lost frames included.

    Parameters
    ----------
    rows
        ``(n_times, n_slopes + n_modes)``: the slopes, and the command that was sent after the frame of that
        row. Slopes of lost frames are zero; while a frame is lost, the previous command stays on the mirror.
        Side by side, one pass filters both. In closed loop, where a command is the sum of the controller's
        command and a poke, the poke follows: ``(n_times, n_slopes + 2 n_modes)``.
    present
        ``(n_times,)``, false where the frame was lost.
    """

    rows: NDArray[np.float32]
    present: NDArray[np.bool_]
    n_slopes: int
    closed: bool = False

    @property
    def slopes(self) -> NDArray[np.float32]:
        """``(n_times, n_slopes)``."""
        return self.rows[:, : self.n_slopes]

    def find_complete_rows(self, past: int, lags: int) -> NDArray[np.intp]:
        """Rows with ``past`` present slopes before them, and with known commands of ``past + lags`` rows."""
        n = self.present.size
        first = past + lags - 1
        if n <= first or self.present.all():
            return np.arange(first, max(n, first))
        is_complete = np.ones(n - first, dtype=bool)
        for k in range(past + 1):
            is_complete &= self.present[first - k : n - k]
        return np.flatnonzero(is_complete) + first

    def select_slopes(self, n_slopes: int) -> AlignedTelemetry:
        """Telemetry of at most ``n_slopes`` evenly spaced slopes."""
        step = max(1, -(-self.n_slopes // n_slopes))
        selected = self.slopes[:, ::step]
        rows = np.concatenate([selected, self.rows[:, self.n_slopes :]], axis=1)
        return AlignedTelemetry(rows, self.present, selected.shape[1], self.closed)


class AlignedBuffer:
    """Preallocated rows of :class:`AlignedTelemetry` that are filled, processed and reused."""

    def __init__(self, n_slopes: int, n_modes: int, rows: int, *, closed: bool = False) -> None:
        self.n_slopes, self.closed = n_slopes, closed
        self._rows = np.zeros((rows, n_slopes + (2 if closed else 1) * n_modes), np.float32)
        self._present = np.ones(rows, np.bool_)
        self._row_views: list[tuple[NDArray[np.float32], ...]] = []
        #: Rows in use, and those of them retained by the last :meth:`retain_last`.
        self.n_filled = self.n_retained = 0

    @property
    def is_full(self) -> bool:
        """Whether there is no room for another frame."""
        return self.n_filled == len(self._present)

    @property
    def n_new(self) -> int:
        """Frames that arrived since the last :meth:`retain_last`."""
        return int(np.count_nonzero(self._present[self.n_retained : self.n_filled]))

    def append(self, slopes: NDArray[np.floating], excitation: NDArray[np.floating]) -> int:
        """Append as many of some consecutive frames as there is room for, and return their number.

        Parameters
        ----------
        slopes, excitation
            ``(n, n_slopes)``, and commands ``(n, n_modes)``, in closed loop with the pokes beside them
            ``(n, 2 n_modes)``.
        """
        k, n = self.n_filled, min(len(slopes), len(self._present) - self.n_filled)
        self._rows[k : k + n, : self.n_slopes] = slopes[:n]
        self._rows[k : k + n, self.n_slopes :] = excitation[:n]
        self.n_filled += n
        return n

    def append_one(self, slopes: NDArray[np.floating], excitation: NDArray[np.floating]) -> int:
        """Append one frame; the buffer must not be full.

        Returns the remaining room in frames; -1 if the frame is not finite, in which case it is not appended.
        """
        if not self._row_views:
            rows = self._rows
            self._row_views = list(zip(rows, rows[:, : self.n_slopes], rows[:, self.n_slopes :], strict=True))
        k = self.n_filled
        row, row_slopes, row_excitation = self._row_views[k]
        row_slopes[...] = slopes
        row_excitation[...] = excitation
        # A sum of squares is finite if all numbers are, and ten times faster than isfinite of all.
        if not isfinite(row.dot(row)):
            return -1
        self.n_filled = k = k + 1
        return len(self._row_views) - k

    def mark_unusable(self, n_taken: int, frames: int) -> int:
        """Mark up to ``frames`` of the last ``n_taken`` frames as lost, the first ones; returns how many."""
        n, first = min(n_taken, frames), self.n_filled - n_taken
        self._rows[first : first + n, : self.n_slopes] = 0
        self._present[first : first + n] = False
        return n

    def append_lost(self, *, flat: bool = False) -> None:
        """Append a lost frame; the buffer must not be full.

        The last command stays on the mirror, so a row must precede it, unless the mirror is ``flat``.
        """
        k = self.n_filled
        self._rows[k] = 0
        if not flat:
            self._rows[k, self.n_slopes :] = self._rows[k - 1, self.n_slopes :]
        self._present[k] = False
        self.n_filled = k + 1

    def telemetry(self) -> AlignedTelemetry:
        """All rows in use, as a view that is valid until the next row is appended."""
        return AlignedTelemetry(
            self._rows[: self.n_filled], self._present[: self.n_filled], self.n_slopes, self.closed
        )

    def retain_last(self, rows: int) -> None:
        """Discard all but the last ``rows`` rows, the past of the next ones."""
        start = max(0, self.n_filled - rows)
        n = self.n_filled - start
        if start:
            self._rows[:n] = self._rows[start : self.n_filled]
            self._present[:n] = self._present[start : self.n_filled]
            self._present[n:] = True
        self.n_filled = self.n_retained = n

    def resize(self, rows: int) -> None:
        """Change the number of rows, at least to those in use."""
        old, used, self._row_views = self.telemetry(), self.n_filled, []
        self._rows = np.zeros((rows, old.rows.shape[1]), np.float32)
        self._present = np.ones(rows, np.bool_)
        self._rows[:used], self._present[:used] = old.rows, old.present


class TelemetryBuffer:
    """Collects the telemetry of a running loop in blocks; an observer of the loop.

    ``rows``: frames of a block; ``history_rows``: rows that each block repeats of the previous one: the past
    of its first frames.

    Attributes
    ----------
    frames, lost
        Number of frames collected, and of frames missing between them.
    """

    def __init__(self, n_slopes: int, n_modes: int, rows: int, history_rows: int) -> None:
        self._buffer = AlignedBuffer(n_slopes, n_modes, rows + history_rows, closed=True)
        self._excitation, self._n_modes, self._history_rows = np.zeros(2 * n_modes), n_modes, history_rows
        self._next_index: int | None = None
        self.frames = self.lost = 0

    def __call__(
        self, index: int, slopes: NDArray[np.float32], command: NDArray[np.float64], poke: NDArray[np.float64]
    ) -> None:
        """Add a frame; see :data:`~escape_hw.calibration.loop.runner.LoopObserver`.

        Raises
        ------
        ValueError
            The slopes or commands are not finite.
        """
        gap = 0 if self._next_index is None else index - self._next_index
        self._next_index = index + 1
        self.lost += gap
        for _ in range(min(gap, 2 * self._history_rows)):
            self._ensure_room()
            self._buffer.append_lost()
        self._ensure_room()
        self._excitation[: self._n_modes], self._excitation[self._n_modes :] = command, poke
        if self._buffer.append_one(slopes, self._excitation) < 0:
            raise ValueError(f"frame {index}: slopes or commands are not finite")
        self.frames += 1

    def _ensure_room(self) -> None:
        if self._buffer.is_full:
            # The blocks are being processed more slowly than frames arrive.
            self._buffer.resize(2 * self._buffer.n_filled)

    def take_block(self) -> tuple[AlignedTelemetry, int]:
        """A copy of the rows collected, and how many rows at its start an earlier block contained."""
        data, start = self._buffer.telemetry(), self._buffer.n_retained
        block = replace(data, rows=data.rows.copy(), present=data.present.copy())
        self._buffer.retain_last(self._history_rows)
        return block, start
