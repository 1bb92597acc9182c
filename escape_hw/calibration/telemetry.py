"""Slopes and pokes on one time line, paired by the camera's frame index."""

from __future__ import annotations

from dataclasses import dataclass
from math import isfinite

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
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

    def complete(self, past: int, lags: int) -> NDArray[np.intp]:
        """Rows whose last ``past`` slopes are all there and whose poke history is known."""
        n = self.present.size
        first = past + lags - 1
        if n <= first or self.present.all():
            return np.arange(first, max(n, first))
        ok = np.ones(n - first, dtype=bool)
        for k in range(past + 1):
            ok &= self.present[first - k : n - k]
        return np.flatnonzero(ok) + first

    def thinned(self, n_slopes: int) -> Telemetry:
        """At most ``n_slopes`` of the slopes, evenly spread."""
        step = max(1, -(-self.n_slopes // n_slopes))
        few = self.slopes[:, ::step]
        rows = np.concatenate([few, self.rows[:, self.n_slopes :]], axis=1)
        return Telemetry(rows, self.present, few.shape[1], self.closed)


class Recorder:
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
        self._slots: list[tuple[NDArray[np.float32], ...]] = []
        #: Rows in use, and those of them that were there at the last :meth:`keep`.
        self.filled = self.kept = 0

    @property
    def full(self) -> bool:
        """Whether there is no room for another frame."""
        return self.filled == len(self._present)

    @property
    def fresh(self) -> int:
        """Frames that arrived since the last :meth:`keep`."""
        return int(np.count_nonzero(self._present[self.kept : self.filled]))

    def take(self, slopes: NDArray[np.floating], driven: NDArray[np.floating]) -> int:
        """Put in consecutive frames ``(n, n_slopes)``, ``(n, n_modes)``; twice the modes in closed loop.

        Returns
        -------
        int
            How many there was room for.
        """
        k, n = self.filled, min(len(slopes), len(self._present) - self.filled)
        self._rows[k : k + n, : self.n_slopes] = slopes[:n]
        self._rows[k : k + n, self.n_slopes :] = driven[:n]
        self.filled += n
        return n

    def take_one(self, slopes: NDArray[np.floating], driven: NDArray[np.floating]) -> int:
        """Put in one frame, as for :meth:`take`, for which there must be room.

        Returns
        -------
        int
            How many more there is room for; -1 if the frame is not finite, and so was not taken.
        """
        if not self._slots:
            rows = self._rows
            self._slots = list(zip(rows, rows[:, : self.n_slopes], rows[:, self.n_slopes :], strict=True))
        k = self.filled
        row, its_slopes, its_drive = self._slots[k]
        its_slopes[...] = slopes
        its_drive[...] = driven
        # A sum of squares is finite when all numbers are, and takes a tenth of the time to ask.
        if not isfinite(row.dot(row)):
            return -1
        self.filled = k = k + 1
        return len(self._slots) - k

    def blind(self, took: int, frames: int) -> int:
        """Count the slopes of the first of the ``took`` frames put in last as lost, up to ``frames`` of them.

        Returns
        -------
        int
            How many were.
        """
        n, first = min(took, frames), self.filled - took
        self._rows[first : first + n, : self.n_slopes] = 0
        self._present[first : first + n] = False
        return n

    def lose_one(self, *, flat: bool = False) -> None:
        """Put in a lost frame, for which there must be room.

        The last command stays on the mirror, for which something must stand before, unless the mirror
        is ``flat``.
        """
        k = self.filled
        self._rows[k] = 0
        if not flat:
            self._rows[k, self.n_slopes :] = self._rows[k - 1, self.n_slopes :]
        self._present[k] = False
        self.filled = k + 1

    def telemetry(self) -> Telemetry:
        """All rows in use; a view, good until more is put in."""
        return Telemetry(self._rows[: self.filled], self._present[: self.filled], self.n_slopes, self.closed)

    def keep(self, rows: int) -> None:
        """Forget all but the last ``rows`` rows, the past of what follows."""
        start = max(0, self.filled - rows)
        n = self.filled - start
        if start:
            self._rows[:n] = self._rows[start : self.filled]
            self._present[:n] = self._present[start : self.filled]
            self._present[n:] = True
        self.filled = self.kept = n

    def resize(self, rows: int) -> None:
        """Give the buffer another number of rows, at least those in use."""
        old, used, self._slots = self.telemetry(), self.filled, []
        self._rows = np.zeros((rows, old.rows.shape[1]), np.float32)
        self._present = np.ones(rows, np.bool_)
        self._rows[:used], self._present[:used] = old.rows, old.present
