"""Streaming DO-CRIME estimator: the interaction matrix from random pokes under turbulence (Lai et al. 2020).

The paper's estimator, ``D = <s c^T> <c c^T>^-1``, is the special case of a filter of length one.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.acquisition.aligned_telemetry import AlignedBuffer, AlignedTelemetry
from escape_hw.calibration.docrime.fit import (
    MIN_DEGREES_OF_FREEDOM,
    DocrimeSolution,
    InitialFit,
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

#: Frames from which response and whitening filter are estimated before the sums start.
BURN_IN_FRAMES = 1000
#: Frames of a block that is added to the sums at once.
BLOCK = 500


class DocrimeEstimator:
    """Streaming DO-CRIME estimator with bounded memory.

    Parameters
    ----------
    order
        Number of past frames that predict the turbulence; 0 for the paper's plain estimator.
    correlations
        Whether to sum the correlations of the slopes' noise, which the errors of SPRINT need. With many
        slopes this takes as much time as all the rest.
    closed
        Closed loop: frames have a poke beside the command, and pokes are the instruments of the commands
        (:class:`~escape_hw.calibration.docrime.regression.InstrumentalVariableSums`).
    known_response
        Temporal response from other frames of the same mirror and sensor.

    Raises
    ------
    ValueError
        ``order`` is below 0 (1 in closed loop), or ``lags`` below 1.
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
        #: Fit of the first frames, and the response since.
        self._fit: InitialFit | None = None
        self._tracker: ResponseTracker | None = None
        self._sums = create_sums(n_slopes, n_modes, closed, correlations=correlations)
        self.frames = self.lost_frames = 0

    def partial_fit(
        self,
        index: int,
        slopes: NDArray[np.float32],
        command: NDArray[np.float64],
        poke: NDArray[np.float64] | None = None,
    ) -> DocrimeEstimator:
        """Add one frame and the command that was sent after it.

        Parameters
        ----------
        index
            Frame index, larger than the one before. A gap removes the pairs of slopes and commands that it
            touches and shifts none.
        slopes
            ``(n_slopes,)``.
        command
            Command as sent ``(n_modes,)``: a poke, or in closed loop the sum of controller and poke.
        poke
            In closed loop, the poke in it ``(n_modes,)``.

        Raises
        ------
        ValueError
            Wrong shape, not finite, or the index does not increase.
        """
        if slopes.shape != self._shapes[0] or command.shape != self._shapes[1]:
            raise ValueError(
                f"slopes {slopes.shape} and command {command.shape} do not fit "
                f"({self.n_slopes},) and ({self.n_modes},)"
            )
        excitation = command
        if self.closed:
            if poke is None or poke.shape != self._shapes[1]:
                raise ValueError(f"in closed loop a poke ({self.n_modes},) is needed beside the command")
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
        """Add many recorded frames, all or none of them.

        Parameters
        ----------
        index
            Frame indices ``(n,)``, increasing.
        slopes, excitation
            ``(n, n_slopes)``, and commands ``(n, n_modes)``, in closed loop with the pokes beside them
            ``(n, 2 n_modes)``.

        Raises
        ------
        ValueError
            As for :meth:`partial_fit`.
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
            raise ValueError(f"frame index went from {last} to {index[k]}; it must increase")
        breaks = np.flatnonzero(steps[1:] != 1) + 1
        for start, end in zip([0, *breaks], [*breaks, n], strict=True):
            self._add_lost_frames(int(steps[start]) - 1)
            done = start
            while done < end:
                n_taken = self._buffer.append(slopes[done:end], excitation[done:end])
                self._unusable -= self._buffer.mark_unusable(n_taken, self._unusable)
                done += n_taken
                if self._buffer.is_full:
                    self._update_sums()
        self._next_index = int(index[-1]) + 1
        return self

    def mark_pause(self) -> None:
        """Mark a pause: the mirror becomes flat, and the next frame may have any index.

        In closed loop the first frames after a pause contribute only their commands, because the commands
        before them are unknown.
        """
        if self._next_index is None:
            return
        self._unusable = self.lags if self.closed else 0
        for _ in range(self._history_rows() + self.order + self.lags):
            self._buffer.append_lost(flat=True)
            if self._buffer.is_full:
                self._update_sums()
        self._next_index = None

    def _add_lost_frames(self, frames: int) -> None:
        """Append lost frames, at most as many as separate the frames before and after them."""
        self.lost_frames += frames
        for _ in range(min(frames, self._history_rows() + self.order + self.lags)):
            self._buffer.append_lost()
            if self._buffer.is_full:
                self._update_sums()

    def _history_rows(self) -> int:
        """Number of rows before a row that its filtered slopes and commands depend on."""
        return 2 * self.order + self.lags

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Plain values and arrays for :meth:`restore`: the sums or, before there is a filter, the frames."""
        if self._fit is None or self._tracker is None:
            data = self._buffer.telemetry()
            return {}, {"rows": data.rows.copy(), "present": data.present.copy()}
        self._update_sums()
        arrays: dict[str, NDArray[Any]] = {
            "whitener": self._fit.whitener,
            "response": self._fit.response.weights,
            "response_covariance": self._fit.response.covariance,
            **{f"sums.{name}": array.copy() for name, array in self._sums.arrays().items()},
            **{f"tracker.{name}": array.copy() for name, array in self._tracker.arrays().items()},
        }
        values = {
            "frames": self.frames,
            "lost_frames": self.lost_frames,
            "spread": self._fit.variance_inflation,
            "count": self._sums.count,
        }
        return values, arrays

    def restore(self, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]]) -> None:
        """Continue from the state of an estimator with the same parameters, after a pause with a flat mirror.

        Raises
        ------
        ValueError
            The estimator already has frames, or the arrays have other shapes.
        """
        if self.frames or self._buffer.n_filled:
            raise ValueError("an estimator that already has frames cannot be restored")
        if "rows" in arrays:
            at = np.flatnonzero(arrays["present"])
            self.extend(at, arrays["rows"][at, : self.n_slopes], arrays["rows"][at, self.n_slopes :])
            self.mark_pause()
            return
        self.frames, self.lost_frames = int(values["frames"]), int(values["lost_frames"])
        response = ResponseEstimate(arrays["response"], arrays["response_covariance"])
        self._fit = InitialFit(arrays["whitener"], response, float(values["spread"]))
        spectra = np.zeros((self.n_modes if self.closed else 1, self.lags, self.lags))
        self._tracker, self._sums.count = ResponseTracker(response, spectra), int(values["count"])
        for prefix, target in (("sums", self._sums.arrays()), ("tracker", self._tracker.arrays())):
            for name, array in target.items():
                saved = arrays.get(f"{prefix}.{name}")
                if saved is None or saved.shape != array.shape:
                    found = "missing" if saved is None else str(saved.shape)
                    raise ValueError(f"{prefix}.{name} is {found}, not {array.shape}; start a new run")
                array[...] = saved
        self._buffer.resize(BLOCK + self._history_rows())
        self._buffer.append_lost(flat=True)
        self._next_index = 0
        self.mark_pause()

    @property
    def frames_received(self) -> int:
        """Number of usable frames received, including those not in the sums yet."""
        return self.frames + self._buffer.n_new - self._unusable

    @property
    def is_initialised(self) -> bool:
        """Whether the filter is known. A solution before that would fix it on too few frames."""
        return self._tracker is not None

    def solve(self) -> DocrimeSolution:
        """Matrix, standard errors and temporal response of the frames so far.

        Raises
        ------
        TooFewFrames
            Fewer complete frames than modes plus a margin; the message states how many are needed.
        CalibrationError
            The sensor does not respond significantly, or the pokes do not span the modes.
        """
        self._update_sums()
        needed = self.n_modes + self.lags + MIN_DEGREES_OF_FREEDOM
        if self._fit is None or self._tracker is None or self._sums.count < needed:
            raise TooFewFrames(
                f"{self._sums.count} complete frames cannot constrain {self.n_modes} modes; "
                f"at least {needed + self.order + self.lags} frames are needed"
            )
        return solve_sums(
            self._sums, self._tracker, self._fit,
            lags=self.lags, frames=self.frames, lost_frames=self.lost_frames,
        )  # fmt: skip

    def preview(self) -> tuple[NDArray[np.float64], NDArray[np.float64]] | None:
        """Matrix and standard errors of the frames in the sums, for display; ``None`` if they are too few.

        Does not change the state, so previews do not affect the result of a run.
        """
        if self._fit is None or self._tracker is None:
            return None
        return estimate_preview(self._sums, self._tracker, self._fit.variance_inflation, self.lags)

    def _update_sums(self) -> None:
        """Add the buffered frames to the sums, after fitting response and filter if they are unknown."""
        buffer = self._buffer
        data, start = buffer.telemetry(), buffer.n_retained
        self.frames += buffer.n_new
        if self._fit is None:
            start = 0
            fit = fit_first_frames(data, self.order, self.lags)
            if fit is not None and self._known_response is not None:
                fit = replace(fit, response=fit.response.combine_with(self._known_response))
            self._fit = fit
        if self._fit is None:
            # Too few frames: the next call uses them again.
            buffer.retain_last(buffer.n_filled)
            buffer.resize(buffer.n_filled + BURN_IN_FRAMES)
            return
        self._add_rows(data, start, self._fit)
        buffer.retain_last(self._history_rows())
        if start == 0:
            buffer.resize(buffer.n_filled + BLOCK)

    def _add_rows(self, data: AlignedTelemetry, start: int, fit: InitialFit) -> None:
        """Add the rows from ``start`` on to the sums, and to the temporal response."""
        block = filter_telemetry(data, fit.whitener, self.lags, start)
        if not block.now.size:
            return
        # Without a filter the differences of the first frames give the more accurate response.
        if self._tracker is not None and self.order:
            before = self._sums.select_sampled().subtract_means()
            matrix = before.solve()
            self._tracker.add(block, matrix, before.signal_power(matrix))
        self._sums.add(block.slopes, block.excitation(fit.response.weights))
        if self._tracker is None:
            self._tracker = ResponseTracker(fit.response, compute_lag_covariances(block, self.lags))


def _not_finite(index: int) -> ValueError:
    return ValueError(f"frame {index}: slopes or pokes are not finite")
