"""DO-CRIME: the interaction matrix from random pokes under turbulence (Lai et al. 2020).

The paper's estimator, ``D = <s c^T> <c c^T>^-1``, is the special case of a filter of length one.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.regression import RegressionSums
from escape_hw.calibration.response import (
    ResponseTracker,
    autocovariance,
    filtered,
    fit_response,
    usable_rows,
)
from escape_hw.calibration.significance import require_response, spread
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import apply_filter, prediction_error_filter
from escape_hw.errors import CalibrationError, TooFewFrames

#: Frames kept to fit the whitening filter before the sums start.
BURN_IN = 1000
#: Frames gathered before the sums are updated: large enough for matrix products to be efficient.
BLOCK = 500
#: Degrees of freedom without which no standard error is worth stating.
MIN_FREEDOM = 20
#: Slopes that the filter, common to all, is found from.
_FEW_SLOPES = 64


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeSolution:
    """A solved DO-CRIME run.

    Parameters
    ----------
    matrix, sigma
        ``(n_slopes, n_modes)``: slopes per unit mode, and standard errors.
    covariance
        Covariance of one frame's filtered residual slopes ``(n_slopes, n_slopes)``; diagonal where
        correlations were not asked for.
    whitener
        The filter used, ``[1]`` for the plain estimator.
    """

    matrix: NDArray[np.float64]
    sigma: NDArray[np.float64]
    response: TemporalResponse
    covariance: NDArray[np.float64]
    whitener: NDArray[np.float64]
    frames: int
    lost_frames: int


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
        self._index = np.empty(BURN_IN, np.int64)
        self._slopes = np.empty((BURN_IN, n_slopes), np.float32)
        self._pokes = np.empty((BURN_IN, n_modes), np.float32)
        self._filled = 0
        self._data: Telemetry | None = None
        self._last_index: int | None = None
        # Rows on the time line, on which long gaps are cut short; the first frame stands at row 0.
        self._row, self._absorbed = -1, -1
        self._whitener: NDArray[np.float64] | None = None
        self._response: TemporalResponse | None = None
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
        if slopes.shape != (self.n_slopes,) or poke.shape != (self.n_modes,):
            raise ValueError(
                f"slopes {slopes.shape} and poke {poke.shape} do not fit "
                f"({self.n_slopes},) and ({self.n_modes},)"
            )
        # A sum of squares is finite when all numbers are, and takes a tenth of the time to ask.
        if not math.isfinite(slopes.dot(slopes) + poke.dot(poke)):
            raise ValueError(f"frame {index}: slopes or poke are not finite")
        if self._last_index is not None and index <= self._last_index:
            raise ValueError(f"frame index went from {self._last_index} to {index}; it must rise")
        k, step = self._filled, 1 if self._last_index is None else index - self._last_index
        self._row += min(step, self._longest_gap() + 1)
        self.lost_frames += step - 1
        self._index[k], self._slopes[k], self._pokes[k] = self._row, slopes, poke
        self._last_index, self._filled = index, k + 1
        if self._filled >= self._room():
            self._absorb()
        return self

    def extend(
        self, index: NDArray[np.int64], slopes: NDArray[np.floating], pokes: NDArray[np.floating]
    ) -> DocrimeEstimator:
        """Take many recorded frames at once; see :meth:`partial_fit`.

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
        if not math.isfinite(np.vdot(slopes, slopes) + np.vdot(pokes, pokes)):
            raise ValueError("slopes or pokes are not finite")
        before = index[:1] - 1 if self._last_index is None else [self._last_index]
        steps = np.diff(index, prepend=before)
        if (steps <= 0).any():
            raise ValueError("frame indices must rise")
        rows = self._row + np.cumsum(np.minimum(steps, self._longest_gap() + 1))
        done = 0
        while done < n:
            take, k = min(self._room() - self._filled, n - done), self._filled
            self._index[k : k + take] = rows[done : done + take]
            self.lost_frames += int(steps[done : done + take].sum()) - take
            self._slopes[k : k + take] = slopes[done : done + take]
            self._pokes[k : k + take] = pokes[done : done + take]
            done += take
            self._last_index, self._filled = int(index[done - 1]), k + take
            self._row = int(rows[done - 1])
            if self._filled >= (BURN_IN if self._response is None else 250):
                self._absorb()
        return self

    def _longest_gap(self) -> int:
        """A gap longer than the memory of filter and response separates the stretches for good."""
        return 2 * (self.order + self.lags)

    def _room(self) -> int:
        return BURN_IN if self._response is None else BLOCK

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
        covariance = sums.residual_power(matrix) / (sums.count - self.n_modes - self.lags)
        if covariance.ndim == 2 and self.order:
            require_response(sums.gram, matrix, covariance, self.lags)
        covariance = covariance if covariance.ndim == 2 else np.diag(covariance)
        variance = np.maximum(np.diag(covariance), 0.0) * self._spread
        sigma = np.sqrt(np.outer(variance, np.diag(np.linalg.inv(sums.gram))))
        scale = self._tracker.scale()
        return DocrimeSolution(
            matrix * scale,
            sigma * abs(scale),
            self._tracker.response(),
            covariance,
            self._whitener,
            self.frames,
            self.lost_frames,
        )

    def _absorb(self) -> None:
        """Move the gathered frames into the sums; fit the filter first if there is none yet."""
        if not self._filled:
            return
        n, self._filled = self._filled, 0
        fresh = Telemetry.from_frames(self._index[:n], self._slopes[:n], self._pokes[:n])
        self.frames += n
        start = 0
        if self._data is not None:
            start = 0 if self._response is None else self._data.present.size
            fresh = self._data.followed_by(fresh, int(self._index[0]) - self._absorbed - 1)
        self._absorbed = int(self._index[n - 1])
        if self._response is None:
            self._fit(fresh)
        if self._response is not None:
            self._sum(fresh, start)
            fresh = fresh.tail(2 * self.order + self.lags)
        self._data = fresh

    def _sum(self, data: Telemetry, start: int) -> None:
        """Add the rows from ``start`` on to the sums."""
        if self._whitener is None or self._response is None:
            raise RuntimeError("sums need the filter and the response")
        slopes, pokes, now = filtered(data, self._whitener, self.lags, start)
        if not now.size:
            return
        self._sums.add(slopes, apply_filter(pokes, self._response.weights, now))
        if self._tracker is None:
            self._tracker = ResponseTracker(
                self._sums.centred().solve(), self._response, now.size, autocovariance(pokes, now, self.lags)
            )
        elif self.order:
            # Without the filter later frames would tell less than the first ones' differences did.
            self._tracker.add(slopes, pokes, now)

    def _fit(self, data: Telemetry) -> None:
        """Temporal response and filter from the first frames: by frame differences, then by the filter.

        Too few frames leave both unset; the next call sees these frames again.
        """
        if usable_rows(data, max(self.order, 1), self.lags).size < self.n_modes + self.lags + MIN_FREEDOM:
            return
        _require_excitation(data.pokes.T @ data.pokes)
        # Differences tell the response well even where the plain estimator is asked for.
        difference, few = np.array([1.0, -1.0]), data.thinned(_FEW_SLOPES)
        response, whitener = fit_response(few, difference, self.lags), np.ones(1)
        if self.order:
            residuals, usable = self._residuals(few, difference, response)
            whitener = prediction_error_filter(residuals, usable, self.order)
            response = fit_response(data, whitener, self.lags)
        else:
            self._spread = self._plain_spread(few, difference, response)
        self._whitener, self._response = whitener, response

    def _plain_spread(
        self, few: Telemetry, difference: NDArray[np.float64], response: TemporalResponse
    ) -> float:
        """Factor on the plain estimator's variance; the differences must show that there is a response."""
        slopes, pokes, now = filtered(few, difference, self.lags)
        seen = apply_filter(pokes, response.weights, now)
        sums = RegressionSums.zeros(slopes.shape[1], self.n_modes, correlations=True)
        matrix = sums.add(slopes, seen).centred().solve()
        left = slopes - seen @ matrix.T.astype(np.float32)
        covariance = left.T @ left / (len(left) - self.n_modes - self.lags)
        require_response(sums.gram, matrix, covariance * spread(left, seen, now, self.lags), self.lags)
        residuals, usable = self._residuals(few, difference, response)
        at = np.flatnonzero(usable)
        return spread(residuals[at], apply_filter(few.pokes, response.weights, at), at, self.lags)

    def _residuals(
        self, data: Telemetry, whitener: NDArray[np.float64], response: TemporalResponse
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Slopes less what the pokes explain ``(n_times, n_slopes)``, and the rows where that is known."""
        slopes, pokes, now = filtered(data, whitener, self.lags)
        sums = RegressionSums.zeros(slopes.shape[1], self.n_modes, correlations=False)
        matrix = sums.add(slopes, apply_filter(pokes, response.weights, now)).centred().solve()
        at = data.complete(0, self.lags)
        residuals = np.zeros_like(data.slopes)
        explained = apply_filter(data.pokes, response.weights, at) @ matrix.T.astype(np.float32)
        residuals[at] = data.slopes[at] - explained
        usable = np.zeros_like(data.present)
        usable[at] = True
        return residuals, usable


def _require_excitation(gram: NDArray[np.floating]) -> None:
    """Raise :class:`CalibrationError` unless pokes with these sums of squares span the modes."""
    values = np.linalg.eigvalsh(gram.astype(np.float64))
    if values[0] <= 1e-7 * values[-1]:
        raise CalibrationError(
            "the pokes do not excite every mode; check that the poke is not zero and not clipped away"
        )
