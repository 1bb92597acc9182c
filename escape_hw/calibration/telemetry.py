"""Slopes and pokes on one time line, paired by the camera's frame index."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True, eq=False)
class Telemetry:
    """A stretch of a run, one row per frame index, lost frames included.

    Parameters
    ----------
    slopes
        ``(n_times, n_slopes)``; rows of lost frames are zero.
    pokes
        ``(n_times, n_modes)``: the poke that was sent after the frame of that row; while a frame is
        lost, the previous poke stays on the mirror.
    present
        ``(n_times,)``, false where the frame was lost.
    """

    slopes: NDArray[np.float32]
    pokes: NDArray[np.floating]
    present: NDArray[np.bool_]

    @classmethod
    def from_frames(
        cls, index: NDArray[np.int64], slopes: NDArray[np.float32], pokes: NDArray[np.floating]
    ) -> Telemetry:
        """Lay frames out by index.

        Parameters
        ----------
        index
            Frame index ``(n,)``, rising.
        slopes, pokes
            ``(n, n_slopes)`` and ``(n, n_modes)``: the slopes of each frame and the poke that was
            sent when it had arrived.
        """
        if index.size and (np.diff(index) <= 0).any():
            raise ValueError("frame indices must rise; was the camera restarted in the middle of a run?")
        at = index - index[0] if index.size else index
        n = int(at[-1]) + 1 if at.size else 0
        present = np.zeros(n, dtype=bool)
        present[at] = True
        latest = np.maximum.accumulate(np.where(present, np.arange(n), 0))
        all_slopes = np.zeros((n, slopes.shape[1]), np.float32)
        all_slopes[at] = slopes
        all_pokes = np.zeros((n, pokes.shape[1]), pokes.dtype)
        all_pokes[at] = pokes
        return cls(all_slopes, all_pokes[latest], present)

    @property
    def n_lost(self) -> int:
        """Number of lost frames."""
        return int((~self.present).sum())

    def complete(self, past: int, lags: int) -> NDArray[np.intp]:
        """Rows whose last ``past`` slopes are all there and whose poke history is known."""
        n = self.present.size
        first = past + lags - 1
        if n <= first:
            return np.empty(0, dtype=np.intp)
        ok = np.ones(n - first, dtype=bool)
        for k in range(past + 1):
            ok &= self.present[first - k : n - k]
        return np.flatnonzero(ok) + first

    def thinned(self, n_slopes: int) -> Telemetry:
        """At most ``n_slopes`` of the slopes, evenly spread."""
        step = max(1, -(-self.slopes.shape[1] // n_slopes))
        return Telemetry(np.ascontiguousarray(self.slopes[:, ::step]), self.pokes, self.present)

    def tail(self, rows: int) -> Telemetry:
        """The last ``rows`` rows, as the past of what follows."""
        start = max(0, self.present.size - rows)
        return Telemetry(self.slopes[start:], self.pokes[start:], self.present[start:])

    def followed_by(self, other: Telemetry, gap: int = 0) -> Telemetry:
        """The stretch itself, ``gap`` lost frames, and another."""
        if gap:
            hold = np.repeat(self.pokes[-1:], gap, axis=0)
            blank = np.zeros((gap, self.slopes.shape[1]), np.float32)
            return Telemetry(
                np.concatenate([self.slopes, blank, other.slopes]),
                np.concatenate([self.pokes, hold, other.pokes]),
                np.concatenate([self.present, np.zeros(gap, bool), other.present]),
            )
        return Telemetry(
            np.concatenate([self.slopes, other.slopes]),
            np.concatenate([self.pokes, other.pokes]),
            np.concatenate([self.present, other.present]),
        )
