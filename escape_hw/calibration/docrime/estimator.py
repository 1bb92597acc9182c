"""DO-CRIME: the interaction matrix from random pokes under turbulence (Lai et al. 2020).

The paper's estimator, ``D = <s c^T> <c c^T>^-1``, is the special case of a filter of length one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.acquisition.telemetry import AlignedBuffer, AlignedTelemetry
from escape_hw.calibration.docrime.fit import (
    MIN_DEGREES_OF_FREEDOM,
    DocrimeSolution,
    create_sums,
    estimate_preview,
    fit_first_frames,
    solve_sums,
)
from escape_hw.calibration.docrime.response import (
    ResponseEstimate,
    ResponseTracker,
    compute_lag_covariances,
    filter_telemetry,
)
from escape_hw.errors import TooFewFrames

#: Frames kept to fit the whitening filter before the sums start.
BURN_IN_FRAMES = 1000
#: Frames gathered before the sums are updated: large enough for matrix products to be efficient.
BLOCK = 500


class DocrimeEstimator:
    """Streaming DO-CRIME estimator with bounded memory.

    Parameters
    ----------
    n_slopes, n_modes
        Sizes.
    order
        Past frames that predict the turbulence; 0 is the paper's plain estimator.
    lags
        Frames over which the temporal response is estimated.
    correlations
        Find how the noise of the slopes is correlated, which SPRINT's error bars want; costs as much
        as the rest when there are many slopes.
    closed
        Frames come with the poke beside the whole command of a closed loop, and pokes are the
        instruments of the commands (:class:`~escape_hw.calibration.docrime.regression.InstrumentalVariableSums`).
    known
        The temporal response by other frames of the same mirror and sensor.
    """

    def __init__(
        self,
        n_slopes: int,
        n_modes: int,
        *,
        order: int = 6,
        lags: int = 5,
        correlations: bool = True,
        closed: bool = False,
        known_response: ResponseEstimate | None = None,
    ) -> None:
        min_order = 1 if closed else 0
        if order < min_order or lags < 1:
            raise ValueError(f"order is {order} and lags {lags}; they must be at least {min_order} and 1")
        self.n_slopes, self.n_modes, self.order, self.lags = n_slopes, n_modes, order, lags
        self.closed, self._known_response = closed, known_response
        self._buffer = AlignedBuffer(n_slopes, n_modes, BURN_IN_FRAMES, closed=closed)
        self._shapes = (n_slopes,), (n_modes,)
        self._excitation = np.zeros(2 * n_modes)
        self._unusable = 0
        self._next_index: int | None = None
        self._whitener: NDArray[np.float64] | None = None
        self._response: ResponseEstimate | None = None
        self._tracker: ResponseTracker | None = None
        self._variance_inflation = 1.0
        self._sums = create_sums(n_slopes, n_modes, closed, correlations=correlations)
        self.frames = self.lost_frames = 0

    def partial_fit(
        self,
        index: int,
        slopes: NDArray[np.float32],
        command: NDArray[np.float64],
        poke: NDArray[np.float64] | None = None,
    ) -> DocrimeEstimator:
        """Take one frame and the command that was sent when it had arrived.

        Parameters
        ----------
        index
            Frame index; it must rise. A gap loses the pairs that it touches and shifts none.
        slopes
            ``(n_slopes,)``.
        command
            ``(n_modes,)``, as it really was sent: a poke, or in closed loop controller and poke together.
        poke
            In closed loop, the poke in it ``(n_modes,)``, as it was drawn.

        Raises
        ------
        ValueError
            Wrong shape, not finite, or an index that does not rise.
        """
        if slopes.shape != self._shapes[0] or command.shape != self._shapes[1]:
            raise ValueError(
                f"slopes {slopes.shape} and command {command.shape} do not fit "
                f"({self.n_slopes},) and ({self.n_modes},)"
            )
        excitation = command
        if self.closed:
            if poke is None or poke.shape != self._shapes[1]:
                raise ValueError(f"in closed loop a poke ({self.n_modes},) stands beside the command")
            excitation = self._excitation
            excitation[: self.n_modes], excitation[self.n_modes :] = command, poke
        if index != self._next_index or self._unusable:
            return self.extend(np.array([index]), slopes[None], excitation[None])
        n_free = self._buffer.append_one(slopes, excitation)
        if n_free < 0:
            raise _not_finite(index)
        self._next_index = index + 1
        if not n_free:
            self._update_sums()
        return self

    def extend(
        self, index: NDArray[np.int64], slopes: NDArray[np.floating], excitation: NDArray[np.floating]
    ) -> DocrimeEstimator:
        """Take many recorded frames at once, or none of them; see :meth:`partial_fit`.

        Parameters
        ----------
        index
            Frame indices ``(n,)``, rising.
        slopes, driven
            ``(n, n_slopes)`` and commands ``(n, n_modes)``, in closed loop with the pokes beside them
            ``(n, 2 n_modes)``.
        """
        n, columns = len(index), self.n_modes * (2 if self.closed else 1)
        if slopes.shape != (n, self.n_slopes) or excitation.shape != (n, columns):
            raise ValueError(
                f"slopes {slopes.shape} and commands {excitation.shape} do not fit {n} frames of "
                f"{self.n_slopes} slopes and {columns} commands"
            )
        if not n:
            return self
        if not math.isfinite(np.vdot(slopes, slopes) + np.vdot(excitation, excitation)):
            finite = np.isfinite(slopes).all(axis=1) & np.isfinite(excitation).all(axis=1)
            raise _not_finite(int(index[np.argmin(finite)]))
        before = index[0] - 1 if self._next_index is None else self._next_index - 1
        steps = np.diff(index, prepend=before)
        if (steps <= 0).any():
            k = int(np.argmax(steps <= 0))
            last = before if k == 0 else index[k - 1]
            raise ValueError(f"frame index went from {last} to {index[k]}; it must rise")
        breaks = np.flatnonzero(steps[1:] != 1) + 1
        for start, end in zip([0, *breaks], [*breaks, n], strict=True):
            self._add_lost_frames(int(steps[start]) - 1)
            done = start
            while done < end:
                n_taken = self._buffer.append(slopes[done:end], excitation[done:end])
                self._unusable -= self._buffer.mark_unusable(n_taken, self._unusable)
                done += n_taken
                if self._buffer.full:
                    self._update_sums()
        self._next_index = int(index[-1]) + 1
        return self

    def mark_pause(self) -> None:
        """The run pauses, the mirror goes flat, and the next frame may have any index.

        A loop is closed again before the first of its frames comes here, and what the mirror did until
        then is not known: in closed loop the first frames only tell their commands.
        """
        if self._next_index is None:
            return
        self._unusable = self.lags if self.closed else 0
        for _ in range(self._history_rows() + self.order + self.lags):
            self._buffer.append_lost(flat=True)
            if self._buffer.full:
                self._update_sums()
        self._next_index = None

    def _add_lost_frames(self, frames: int) -> None:
        """Lay out lost frames; a gap longer than all memory separates the stretches for good."""
        self.lost_frames += frames
        for _ in range(min(frames, self._history_rows() + self.order + self.lags)):
            self._buffer.append_lost()
            if self._buffer.full:
                self._update_sums()

    def _history_rows(self) -> int:
        """Rows before a row that its filtered slopes and pokes are made of."""
        return 2 * self.order + self.lags

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Plain values and arrays from which :meth:`restore` makes this estimator again, for another run.

        These are the sums or, before there is a filter, the frames themselves.
        """
        if self._whitener is None or self._response is None or self._tracker is None:
            # A filter found now would be that of too few frames.
            data = self._buffer.telemetry()
            return {}, {"rows": data.rows.copy(), "present": data.present.copy()}
        self._update_sums()
        arrays: dict[str, NDArray[Any]] = {
            "whitener": self._whitener,
            "response": self._response.weights,
            "response_covariance": self._response.covariance,
            **{f"sums.{name}": array.copy() for name, array in self._sums.arrays().items()},
            **{f"tracker.{name}": array.copy() for name, array in self._tracker.arrays().items()},
        }
        values = {
            "frames": self.frames,
            "lost_frames": self.lost_frames,
            "spread": self._variance_inflation,
            "count": self._sums.count,
        }
        return values, arrays

    def restore(self, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Go on from what :meth:`state` of an equal estimator gave; the mirror was flat meanwhile.

        Raises
        ------
        ValueError
            The estimator has taken frames, or the arrays have other shapes.
        """
        if self.frames or self._buffer.n_filled:
            raise ValueError("an estimator that has taken frames cannot be restored")
        if "rows" in arrays:
            # Frames from before there was a filter, by their places on the time line.
            at = np.flatnonzero(arrays["present"])
            self.extend(at, arrays["rows"][at, : self.n_slopes], arrays["rows"][at, self.n_slopes :])
            self.mark_pause()
            return
        self.frames, self.lost_frames = int(values["frames"]), int(values["lost_frames"])
        self._whitener, self._variance_inflation = arrays["whitener"], float(values["spread"])
        self._response = ResponseEstimate(arrays["response"], arrays["response_covariance"])
        spectra = np.zeros((self.n_modes if self.closed else 1, self.lags, self.lags))
        self._tracker, self._sums.count = ResponseTracker(self._response, spectra), int(values["count"])
        for prefix, target in (("sums", self._sums.arrays()), ("tracker", self._tracker.arrays())):
            for name, array in target.items():
                kept = arrays.get(f"{prefix}.{name}")
                if kept is None or kept.shape != array.shape:
                    found = "missing" if kept is None else str(kept.shape)
                    raise ValueError(f"{prefix}.{name} is {found}, not {array.shape}; begin the run again")
                array[...] = kept
        self._buffer.resize(BLOCK + self._history_rows())
        # Rows before the first that is new: the mirror was flat, no slopes are known.
        self._buffer.append_lost(flat=True)
        self._next_index = 0
        self.mark_pause()

    @property
    def frames_received(self) -> int:
        """Frames taken, also those not in the sums yet; less those whose slopes will not be taken."""
        return self.frames + self._buffer.n_new - self._unusable

    @property
    def is_initialised(self) -> bool:
        """Whether the filter is found, so that a solution in the middle of a run costs nothing later."""
        return self._tracker is not None

    def solve(self) -> DocrimeSolution:
        """The matrix, its standard errors and the temporal response so far.

        Raises
        ------
        TooFewFrames
            Fewer complete frames than modes plus a margin; says how many are needed.
        CalibrationError
            The mirror does not respond, or the pokes do not span the modes.
        """
        self._update_sums()
        needed = self.n_modes + self.lags + MIN_DEGREES_OF_FREEDOM
        if self._whitener is None or self._tracker is None or self._sums.count < needed:
            raise TooFewFrames(
                f"{self._sums.count} complete frames cannot constrain {self.n_modes} modes; "
                f"at least {needed + self.order + self.lags} frames are needed"
            )
        return solve_sums(
            self._sums, self._tracker, self._whitener, self._variance_inflation,
            lags=self.lags, frames=self.frames, lost_frames=self.lost_frames,
        )  # fmt: skip

    def preview(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Matrix and standard errors by the frames summed so far, for those who watch; ``None``: too few.

        It changes nothing: a run ends with the same numbers whether it is watched or not.
        """
        if self._tracker is None:
            return None
        scale = self._tracker.scale(self._tracker.response())
        return estimate_preview(self._sums, scale, self.lags, self._variance_inflation)

    def _update_sums(self) -> None:
        """Move the gathered frames into the sums; fit the filter first if there is none yet."""
        buffer = self._buffer
        data, start = buffer.telemetry(), buffer.kept
        self.frames += buffer.n_new
        if self._response is None:
            start = 0
            found = fit_first_frames(data, self.order, self.lags)
            if found is not None:
                self._whitener, self._variance_inflation = found.whitener, found.variance_inflation
                first = found.response
                self._response = (
                    first if self._known_response is None else first.combine_with(self._known_response)
                )
        if self._response is not None:
            self._add_rows(data, start)
        buffer.retain_last(buffer.n_filled if self._response is None else self._history_rows())
        if self._response is None:
            # Not enough to go by yet: the next call sees these frames again.
            buffer.resize(buffer.n_filled + BURN_IN_FRAMES)
        elif start == 0:
            buffer.resize(buffer.n_filled + BLOCK)

    def _add_rows(self, data: AlignedTelemetry, start: int) -> None:
        """Add the rows from ``start`` on to the sums."""
        if self._whitener is None or self._response is None:
            raise RuntimeError("sums need the filter and the response")
        block = filter_telemetry(data, self._whitener, self.lags, start)
        if not block.now.size:
            return
        # Without the filter later frames would tell less than the first ones' differences did.
        if self._tracker is not None and self.order:
            before = self._sums.centred_sample()
            matrix = before.solve()
            self._tracker.add(block, matrix, before.signal_power(matrix))
        self._sums.add(block.slopes, block.excitation(self._response.weights))
        if self._tracker is None:
            self._tracker = ResponseTracker(self._response, compute_lag_covariances(block, self.lags))


def _not_finite(index: int) -> ValueError:
    return ValueError(f"frame {index}: slopes or pokes are not finite")
