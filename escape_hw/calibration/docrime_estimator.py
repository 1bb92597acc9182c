"""DO-CRIME: the interaction matrix from random pokes under turbulence (Lai et al. 2020).

The paper's estimator, ``D = <s c^T> <c c^T>^-1``, is the special case of a filter of length one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lapack

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.regression import RegressionSums
from escape_hw.calibration.response import (
    SLOPES,
    ResponseTracker,
    autocovariance,
    filtered,
    fit_response,
    usable_rows,
)
from escape_hw.calibration.significance import require_response, spread
from escape_hw.calibration.telemetry import Recorder, Telemetry
from escape_hw.calibration.whitening import apply_filter, prediction_error_filter
from escape_hw.errors import CalibrationError, TooFewFrames

#: Frames kept to fit the whitening filter before the sums start.
BURN_IN = 1000
#: Frames gathered before the sums are updated: large enough for matrix products to be efficient.
BLOCK = 500
#: Degrees of freedom without which no standard error is worth stating.
MIN_FREEDOM = 20
#: Slopes that the filter, common to all, is found from.
_FEW_SLOPES = 32


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeSolution:
    """A solved DO-CRIME run.

    Parameters
    ----------
    matrix, sigma
        ``(n_slopes, n_modes)``: slopes per unit mode, and standard errors of single elements beside a
        gain that they share.
    covariance
        Covariance of one frame's filtered residual slopes ``(n_slopes, n_slopes)``; diagonal where
        correlations were not asked for.
    gram
        Sum over frames of filtered pokes times filtered pokes ``(n_modes, n_modes)``.
    variance
        Variance of each slope's filtered noise, with what its correlation over time adds ``(n_slopes,)``.
    whitener
        The filter used, ``[1]`` for the plain estimator.
    gain_sigma
        Relative standard error of the gain that all elements share: an error of the temporal response,
        which is scaled to sum 1, scales the whole matrix.
    """

    matrix: NDArray[np.float64]
    sigma: NDArray[np.float64]
    response: TemporalResponse
    covariance: NDArray[np.float64]
    gram: NDArray[np.float64]
    variance: NDArray[np.float64]
    whitener: NDArray[np.float64]
    frames: int
    lost_frames: int
    gain_sigma: float


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
    """

    def __init__(
        self, n_slopes: int, n_modes: int, *, order: int = 6, lags: int = 5, correlations: bool = True
    ) -> None:
        if order < 0 or lags < 1:
            raise ValueError(f"order is {order} and lags {lags}; they must be at least 0 and 1")
        self.n_slopes, self.n_modes, self.order, self.lags = n_slopes, n_modes, order, lags
        self._recorder = Recorder(n_slopes, n_modes, BURN_IN)
        self._shapes = (n_slopes,), (n_modes,)
        self._next: int | None = None
        self._whitener: NDArray[np.float64] | None = None
        self._response: TemporalResponse | None = None
        self._response_covariance = np.zeros((lags, lags))
        self._tracker: ResponseTracker | None = None
        self._spread = 1.0
        self._sums = RegressionSums.zeros(n_slopes, n_modes, correlations=correlations)
        self.frames = self.lost_frames = 0

    def partial_fit(
        self, index: int, slopes: NDArray[np.float32], poke: NDArray[np.float64]
    ) -> DocrimeEstimator:
        """Take one frame and the poke that was sent when it had arrived.

        Parameters
        ----------
        index
            Frame index; it must rise. A gap loses the pairs that it touches and shifts none.
        slopes
            ``(n_slopes,)``.
        poke
            ``(n_modes,)``, as it really was sent.

        Raises
        ------
        ValueError
            Wrong shape, not finite, or an index that does not rise.
        """
        if slopes.shape != self._shapes[0] or poke.shape != self._shapes[1]:
            raise ValueError(
                f"slopes {slopes.shape} and poke {poke.shape} do not fit "
                f"({self.n_slopes},) and ({self.n_modes},)"
            )
        if index != self._next:
            return self.extend(np.array([index]), slopes[None], poke[None])
        room = self._recorder.take_one(slopes, poke)
        if room < 0:
            raise _not_finite(index)
        self._next = index + 1
        if not room:
            self._absorb()
        return self

    def extend(
        self, index: NDArray[np.int64], slopes: NDArray[np.floating], pokes: NDArray[np.floating]
    ) -> DocrimeEstimator:
        """Take many recorded frames at once, or none of them; see :meth:`partial_fit`.

        Parameters
        ----------
        index
            Frame indices ``(n,)``, rising.
        slopes, pokes
            ``(n, n_slopes)`` and ``(n, n_modes)``.
        """
        n = len(index)
        if slopes.shape != (n, self.n_slopes) or pokes.shape != (n, self.n_modes):
            raise ValueError(
                f"slopes {slopes.shape} and pokes {pokes.shape} do not fit {n} frames of "
                f"{self.n_slopes} slopes and {self.n_modes} modes"
            )
        if not n:
            return self
        if not math.isfinite(np.vdot(slopes, slopes) + np.vdot(pokes, pokes)):
            fine = np.isfinite(slopes).all(axis=1) & np.isfinite(pokes).all(axis=1)
            raise _not_finite(int(index[np.argmin(fine)]))
        before = index[0] - 1 if self._next is None else self._next - 1
        steps = np.diff(index, prepend=before)
        if (steps <= 0).any():
            k = int(np.argmax(steps <= 0))
            last = before if k == 0 else index[k - 1]
            raise ValueError(f"frame index went from {last} to {index[k]}; it must rise")
        breaks = np.flatnonzero(steps[1:] != 1) + 1
        for start, end in zip([0, *breaks], [*breaks, n], strict=True):
            self._lose(int(steps[start]) - 1)
            done = start
            while done < end:
                done += self._recorder.take(slopes[done:end], pokes[done:end])
                if self._recorder.full:
                    self._absorb()
        self._next = int(index[-1]) + 1
        return self

    def _lose(self, frames: int) -> None:
        """Lay out lost frames; a gap longer than all memory separates the stretches for good."""
        self.lost_frames += frames
        for _ in range(min(frames, self._memory() + self.order + self.lags)):
            self._recorder.lose_one()
            if self._recorder.full:
                self._absorb()

    def _memory(self) -> int:
        """Rows before a row that its filtered slopes and pokes are made of."""
        return 2 * self.order + self.lags

    def solve(self) -> DocrimeSolution:
        """The matrix, its standard errors and the temporal response so far.

        Raises
        ------
        TooFewFrames
            Fewer complete frames than modes plus a margin; says how many are needed.
        CalibrationError
            The mirror does not respond, or the pokes do not span the modes.
        """
        self._absorb()
        needed = self.n_modes + self.lags + MIN_FREEDOM
        if self._whitener is None or self._tracker is None or self._sums.count < needed:
            raise TooFewFrames(
                f"{self._sums.count} complete frames cannot constrain {self.n_modes} modes; "
                f"at least {needed + self.order + self.lags} frames are needed"
            )
        sums = self._sums.centred()
        _require_excitation(sums.gram)
        matrix = sums.solve()
        freedom = sums.count - self.n_modes - self.lags
        if self.order:
            rows, power = sums.sample(matrix)
            require_response(sums.gram, rows, power / freedom, self.lags)
        covariance = sums.residual_power(matrix) / freedom
        covariance = covariance if covariance.ndim == 2 else np.diag(covariance)
        variance = np.maximum(np.diag(covariance), 0.0) * self._spread
        sigma = np.outer(np.sqrt(variance), np.sqrt(sums.inverse_diagonal()))
        scale = self._tracker.scale()
        return DocrimeSolution(
            matrix * scale,
            sigma * abs(scale),
            self._tracker.response(),
            covariance,
            sums.gram / scale**2,
            variance,
            self._whitener,
            self.frames,
            self.lost_frames,
            self._tracker.gain_sigma(),
        )

    def _absorb(self) -> None:
        """Move the gathered frames into the sums; fit the filter first if there is none yet."""
        recorder = self._recorder
        data, start = recorder.telemetry(), recorder.kept
        self.frames += recorder.fresh
        if self._response is None:
            start = 0
            self._fit(data)
        if self._response is not None:
            self._sum(data, start)
        recorder.keep(recorder.filled if self._response is None else self._memory())
        if self._response is None:
            # Not enough to go by yet: the next call sees these frames again.
            recorder.resize(recorder.filled + BURN_IN)
        elif start == 0:
            recorder.resize(recorder.filled + BLOCK)

    def _sum(self, data: Telemetry, start: int) -> None:
        """Add the rows from ``start`` on to the sums."""
        if self._whitener is None or self._response is None:
            raise RuntimeError("sums need the filter and the response")
        block = filtered(data, self._whitener, self.lags, start)
        if not block.now.size:
            return
        self._sums.add(block.slopes, block.pokes_through(self._response.weights))
        if self._tracker is None:
            self._tracker = ResponseTracker(
                self._sums.centred().solve(), self._response, self._response_covariance, block.now.size,
                autocovariance(block, self.lags),
            )  # fmt: skip
        elif self.order:
            # Without the filter later frames would tell less than the first ones' differences did.
            self._tracker.add(block)

    def _fit(self, data: Telemetry) -> None:
        """Temporal response and filter from the first frames: by frame differences, then by the filter.

        Too few frames leave both unset; the next call sees these frames again.
        """
        if usable_rows(data, max(self.order, 1), self.lags).size < self.n_modes + self.lags + MIN_FREEDOM:
            return
        _require_excitation(data.pokes.T @ data.pokes)
        # Differences tell the response well even where the plain estimator is asked for.
        difference, few = np.array([1.0, -1.0]), data.thinned(_FEW_SLOPES if self.order else SLOPES)
        (response, covariance), whitener = fit_response(few, difference, self.lags), np.ones(1)
        if self.order:
            residuals, usable = self._residuals(few, difference, response)
            whitener = prediction_error_filter(residuals, usable, self.order)
            response, covariance = fit_response(data, whitener, self.lags)
        else:
            self._spread = self._plain_spread(few, difference, response)
        self._whitener, self._response, self._response_covariance = whitener, response, covariance

    def _plain_spread(
        self, few: Telemetry, difference: NDArray[np.float64], response: TemporalResponse
    ) -> float:
        """Factor on the plain estimator's variance; the differences must show that there is a response."""
        block = filtered(few, difference, self.lags)
        slopes, seen, now = block.slopes, block.pokes_through(response.weights), block.now
        sums = RegressionSums.zeros(slopes.shape[1], self.n_modes, correlations=True)
        matrix = sums.add(slopes, seen).centred().solve()
        left = slopes - seen @ matrix.T.astype(np.float32)
        covariance = left.T @ left / (len(left) - self.n_modes - self.lags)
        require_response(sums.gram, matrix, covariance * spread(left, seen, now, self.lags), self.lags)
        residuals, usable = self._residuals(few, difference, response)
        at = np.flatnonzero(usable)
        return spread(
            residuals[at], apply_filter(few.rows, response.weights, at, few.n_slopes), at, self.lags
        )

    def _residuals(
        self, data: Telemetry, whitener: NDArray[np.float64], response: TemporalResponse
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Slopes less what the pokes explain ``(n_times, n_slopes)``, and the rows where that is known."""
        block = filtered(data, whitener, self.lags)
        sums = RegressionSums.zeros(data.n_slopes, self.n_modes, correlations=False)
        matrix = sums.add(block.slopes, block.pokes_through(response.weights)).centred().solve()
        at = data.complete(0, self.lags)
        residuals = np.zeros_like(data.slopes)
        explained = apply_filter(data.rows, response.weights, at, data.n_slopes) @ matrix.T.astype(np.float32)
        residuals[at] = data.slopes[at] - explained
        usable = np.zeros_like(data.present)
        usable[at] = True
        return residuals, usable


def _require_excitation(gram: NDArray[np.floating]) -> None:
    """Raise :class:`CalibrationError` unless pokes with these sums of squares span the modes."""
    # Factor and estimated condition: a twentieth of the time of the eigenvalues.
    size = np.abs(gram).sum(axis=0).max()
    factor, failed = lapack.dpotrf(gram)
    if failed or lapack.dpocon(factor, size)[0] <= 1e-7:
        raise CalibrationError(
            "the pokes do not excite every mode; check that the poke is not zero and not clipped away"
        )


def _not_finite(index: int) -> ValueError:
    return ValueError(f"frame {index}: slopes or pokes are not finite")
