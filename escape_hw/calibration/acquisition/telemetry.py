"""Slopes, commands and pokes aligned by camera frame index, and buffers that collect them."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class AlignedTelemetry:
    """A stretch of a run, one row per frame index, lost frames included.

    Parameters
    ----------
    rows
        ``(n_times, n_slopes + n_modes)``: the slopes, and the command that was sent after the frame of
        that row. Slopes of lost frames are zero; while a frame is lost, the previous command stays on
        the mirror. Side by side, one pass filters both. In closed loop, where a command holds more
        than a poke, the poke in it follows: ``(n_times, n_slopes + 2 n_modes)``.
    present
        ``(n_times,)``, false where the frame was lost.
    n_slopes
        How many columns are slopes.
    closed
        Whether the pokes stand beside the commands.
    """

    rows: NDArray[np.float32]
    present: NDArray[np.bool_]
    n_slopes: int
    closed: bool = False

    @property
    def slopes(self) -> NDArray[np.float32]:
        """``(n_times, n_slopes)``."""
        return self.rows[:, : self.n_slopes]

    @property
    def n_modes(self) -> int:
        """Number of modes."""
        return int(self.rows.shape[1] - self.n_slopes) // (2 if self.closed else 1)

    @property
    def commands(self) -> NDArray[np.float32]:
        """``(n_times, n_modes)``; in closed loop the controller's part and the poke together."""
        return self.rows[:, self.n_slopes : self.n_slopes + self.n_modes]

    @property
    def pokes(self) -> NDArray[np.float32]:
        """``(n_times, n_modes)``; in open loop these are the commands."""
        return self.rows[:, self.rows.shape[1] - self.n_modes :]

    def find_complete_rows(self, past: int, lags: int) -> NDArray[np.intp]:
        """Rows whose last ``past`` slopes are all there and whose poke history is known."""
        n = self.present.size
        first = past + lags - 1
        if n <= first or self.present.all():
            return np.arange(first, max(n, first))
        is_complete = np.ones(n - first, dtype=bool)
        for k in range(past + 1):
            is_complete &= self.present[first - k : n - k]
        return np.flatnonzero(is_complete) + first

    def select_slopes(self, n_slopes: int) -> AlignedTelemetry:
        """At most ``n_slopes`` of the slopes, evenly spread."""
        step = max(1, -(-self.n_slopes // n_slopes))
        selected = self.slopes[:, ::step]
        rows = np.concatenate([selected, self.rows[:, self.n_slopes :]], axis=1)
        return AlignedTelemetry(rows, self.present, selected.shape[1], self.closed)


class AlignedBuffer:
    """Gathers the frames of a run on its time line, in a buffer that is used again and again.

    Parameters
    ----------
    n_slopes, n_modes
        Sizes.
    rows
        Rows of the buffer.
    closed
        Whether frames come with the poke beside the command.
    """

    def __init__(self, n_slopes: int, n_modes: int, rows: int, *, closed: bool = False) -> None:
        self.n_slopes, self.closed = n_slopes, closed
        self._rows = np.zeros((rows, n_slopes + (2 if closed else 1) * n_modes), np.float32)
        self._present = np.ones(rows, np.bool_)
        self._row_views: list[tuple[NDArray[np.float32], ...]] = []
        #: Rows in use, and those of them that were there at the last :meth:`retain_last`.
        self.n_filled = self.kept = 0

    @property
    def full(self) -> bool:
        """Whether there is no room for another frame."""
        return self.n_filled == len(self._present)

    @property
    def n_new(self) -> int:
        """Frames that arrived since the last :meth:`retain_last`."""
        return int(np.count_nonzero(self._present[self.kept : self.n_filled]))

    def append(self, slopes: NDArray[np.floating], excitation: NDArray[np.floating]) -> int:
        """Put in consecutive frames ``(n, n_slopes)``, ``(n, n_modes)``; twice the modes in closed loop.

        Returns
        -------
        int
            How many there was room for.
        """
        k, n = self.n_filled, min(len(slopes), len(self._present) - self.n_filled)
        self._rows[k : k + n, : self.n_slopes] = slopes[:n]
        self._rows[k : k + n, self.n_slopes :] = excitation[:n]
        self.n_filled += n
        return n

    def append_one(self, slopes: NDArray[np.floating], excitation: NDArray[np.floating]) -> int:
        """Put in one frame, as for :meth:`append`, for which there must be room.

        Returns
        -------
        int
            How many more there is room for; -1 if the frame is not finite, and so was not taken.
        """
        if not self._row_views:
            rows = self._rows
            self._row_views = list(zip(rows, rows[:, : self.n_slopes], rows[:, self.n_slopes :], strict=True))
        k = self.n_filled
        row, row_slopes, row_excitation = self._row_views[k]
        row_slopes[...] = slopes
        row_excitation[...] = excitation
        # A sum of squares is finite when all numbers are, and takes a tenth of the time to ask.
        if not isfinite(row.dot(row)):
            return -1
        self.n_filled = k = k + 1
        return len(self._row_views) - k

    def mark_unusable(self, n_taken: int, frames: int) -> int:
        """Count the slopes of the first of the ``n_taken`` frames put in last as lost, up to ``frames`` of them.

        Returns
        -------
        int
            How many were.
        """
        n, first = min(n_taken, frames), self.n_filled - n_taken
        self._rows[first : first + n, : self.n_slopes] = 0
        self._present[first : first + n] = False
        return n

    def append_lost(self, *, flat: bool = False) -> None:
        """Put in a lost frame, for which there must be room.

        The last command stays on the mirror, for which something must stand before, unless the mirror
        is ``flat``.
        """
        k = self.n_filled
        self._rows[k] = 0
        if not flat:
            self._rows[k, self.n_slopes :] = self._rows[k - 1, self.n_slopes :]
        self._present[k] = False
        self.n_filled = k + 1

    def telemetry(self) -> AlignedTelemetry:
        """All rows in use; a view, good until more is put in."""
        return AlignedTelemetry(
            self._rows[: self.n_filled], self._present[: self.n_filled], self.n_slopes, self.closed
        )

    def retain_last(self, rows: int) -> None:
        """Forget all but the last ``rows`` rows, the past of what follows."""
        start = max(0, self.n_filled - rows)
        n = self.n_filled - start
        if start:
            self._rows[:n] = self._rows[start : self.n_filled]
            self._present[:n] = self._present[start : self.n_filled]
            self._present[n:] = True
        self.n_filled = self.kept = n

    def resize(self, rows: int) -> None:
        """Give the buffer another number of rows, at least those in use."""
        old, used, self._row_views = self.telemetry(), self.n_filled, []
        self._rows = np.zeros((rows, old.rows.shape[1]), np.float32)
        self._present = np.ones(rows, np.bool_)
        self._rows[:used], self._present[:used] = old.rows, old.present


class TelemetryBuffer:
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

    def __init__(self, n_slopes: int, n_modes: int, rows: int, history_rows: int) -> None:
        self._buffer = AlignedBuffer(n_slopes, n_modes, rows + history_rows, closed=True)
        self._excitation, self._n_modes, self._history_rows = np.zeros(2 * n_modes), n_modes, history_rows
        self._next_index: int | None = None
        self.frames = self.lost = 0

    def __call__(
        self, index: int, slopes: NDArray[np.float32], command: NDArray[np.float64], poke: NDArray[np.float64]
    ) -> None:
        """Take a frame; see :data:`~escape_hw.calibration.loop.runner.LoopObserver`.

        Raises
        ------
        ValueError
            The slopes are not finite.
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
        if self._buffer.full:
            # Whoever works the blocks off is late.
            self._buffer.resize(2 * self._buffer.n_filled)

    def take_block(self) -> tuple[AlignedTelemetry, int]:
        """A copy of the rows gathered, and the first of them that was not handed over before."""
        data, start = self._buffer.telemetry(), self._buffer.kept
        block = AlignedTelemetry(data.rows.copy(), data.present.copy(), data.n_slopes, data.closed)
        self._buffer.retain_last(self._history_rows)
        return block, start

    def rewind(self) -> None:
        """Forget what was gathered."""
        self._buffer.retain_last(0)
        self._next_index = None
