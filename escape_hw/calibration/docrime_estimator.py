"""DO-CRIME: the interaction matrix from random pokes under turbulence (Lai et al. 2020).

The paper's estimator, ``D = <s c^T> <c c^T>^-1``, is the special case of a filter of length one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.lagged_sums import LaggedSums
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import autocovariance, prediction_error_filter
from escape_hw.errors import CalibrationError, TooFewFrames

#: Frames kept to fit the whitening filter before the sums start.
BURN_IN = 1000
#: Frames gathered before the sums are updated: large enough for matrix products to be efficient.
BLOCK = 256
#: Degrees of freedom without which no standard error is worth stating.
MIN_FREEDOM = 20
#: Standard deviations by which the mirror's share of the slopes must exceed what chance makes.
_CLEARLY = 5.0
_ONE = np.ones(1)


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeSolution:
    """A solved DO-CRIME run.

    Parameters
    ----------
    matrix, sigma
        ``(n_slopes, n_modes)``: slopes per unit mode, and standard errors.
    covariance
        Covariance of one frame's filtered residual slopes ``(n_slopes, n_slopes)``.
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
    """

    def __init__(self, n_slopes: int, n_modes: int, *, order: int = 6, lags: int = 5) -> None:
        if order < 0 or lags < 1:
            raise ValueError(f"order is {order} and lags {lags}; they must be at least 0 and 1")
        self.n_slopes, self.n_modes, self.order, self.lags = n_slopes, n_modes, order, lags
        self._index: list[int] = []
        self._slopes: list[NDArray[np.float32]] = []
        self._pokes: list[NDArray[np.float64]] = []
        self._data: Telemetry | None = None
        self._last_index: int | None = None
        self._whitener: NDArray[np.float64] | None = None
        self._response: TemporalResponse | None = None
        self._spread = 1.0
        self._sums = LaggedSums.zeros(n_slopes, n_modes, 1)
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
                f"slopes {slopes.shape} and poke {poke.shape} do not fit ({self.n_slopes},) and ({self.n_modes},)"
            )
        if not (np.isfinite(slopes).all() and np.isfinite(poke).all()):
            raise ValueError(f"frame {index}: slopes or poke are not finite")
        previous = self._index[-1] if self._index else self._last_index
        if previous is not None and index <= previous:
            raise ValueError(f"frame index went from {previous} to {index}; it must rise")
        self._index.append(index)
        self._slopes.append(slopes)
        self._pokes.append(poke)
        if len(self._index) >= (BURN_IN if self._response is None else BLOCK):
            self._absorb()
        return self

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
        if self._whitener is None or self._sums.count < needed:
            raise TooFewFrames(
                f"{self._sums.count} complete frames cannot constrain {self.n_modes} modes; "
                f"at least {needed + self.order + self.lags} frames are needed"
            )
        sums = self._sums.centred()
        if self._response is None or np.linalg.cond(sums.gram[0, :, 0, :]) > 1e12:
            raise CalibrationError(
                "the pokes do not excite every mode; check that the poke is not zero and not clipped away"
            )
        matrix, gram = sums.solve(_ONE)
        freedom = sums.count - self.n_modes - self.lags
        covariance = sums.residual_power(matrix, _ONE) / freedom
        self._require_response(matrix, gram, covariance * self._spread, self._response.weights.size)
        variance = np.maximum(np.diag(covariance), 0.0) * self._spread
        sigma = np.sqrt(np.outer(variance, np.diag(np.linalg.inv(gram))))
        return DocrimeSolution(
            matrix, sigma, self._response, covariance, self._whitener, self.frames, self.lost_frames
        )

    def _require_response(
        self,
        matrix: NDArray[np.float64],
        gram: NDArray[np.float64],
        covariance: NDArray[np.float64],
        lags: int,
    ) -> None:
        """Refuse a matrix that chance alone explains: the sensor does not see the mirror.

        Without a response, the power that the pokes explain is that of the noise on average, with
        the scatter of as many degrees of freedom as modes and independent slopes have; choosing the
        temporal response that explains most adds what the largest eigenvalue of a Wishart matrix
        exceeds the mean by (Marchenko & Pastur 1967).
        """
        noise = float(np.trace(covariance))
        if not noise > 0:
            return
        explained = float(np.einsum("sm,mn,sn->", matrix, gram, matrix, optimize=True))
        freedom = self.n_modes * noise**2 / float(np.square(covariance).sum())
        chance = (1 + np.sqrt(lags / freedom)) ** 2 * (1 + _CLEARLY * np.sqrt(2 / freedom))
        ratio = explained / (self.n_modes * noise)
        if ratio < chance:
            raise CalibrationError(
                f"the wavefront sensor does not respond to the mirror: the pokes explain {ratio:.2f} times "
                f"the power of the noise, and chance alone up to {chance:.2f}; check that the mirror is in the "
                "beam and powered, or use larger pokes or more frames"
            )

    def _absorb(self) -> None:
        """Move the gathered frames into the sums; fit the filter first if there is none yet."""
        if not self._index:
            return
        fresh = Telemetry.from_frames(
            np.array(self._index, dtype=np.int64), np.stack(self._slopes), np.stack(self._pokes)
        )
        self.frames += len(self._index)
        self.lost_frames += fresh.n_lost
        start, gap = 0, 0
        if self._data is not None and self._last_index is not None:
            gap = self._index[0] - self._last_index - 1
            self.lost_frames += gap
            start = 0 if self._response is None else self._data.present.size
            # A gap longer than the memory of filter and response separates the stretches for good.
            fresh = self._data.followed_by(fresh, min(gap, 2 * (self.order + self.lags)))
        self._last_index = self._index[-1]
        self._index, self._slopes, self._pokes = [], [], []
        if self._whitener is None or self._response is None:
            self._fit(fresh)
        if self._whitener is not None and self._response is not None:
            self._sums.add(fresh, self._whitener, start, self._response.weights)
            fresh = fresh.tail(2 * self.order + self.lags)
        self._data = fresh

    def _fit(self, data: Telemetry) -> None:
        """Filter and temporal response from the first frames: frame differences, then two rounds.

        Too few frames leave both unset; the next call sees these frames again.
        """
        # Differences tell the response well even where the plain estimator is asked for.
        whitener = np.array([1.0, -1.0])
        for last in (False, False, True) if self.order else (True,):
            sums = LaggedSums.zeros(self.n_slopes, self.n_modes, self.lags)
            sums.add(data, whitener)
            if sums.count < self.n_modes + self.lags + MIN_FREEDOM:
                return
            sums = sums.centred()
            response = sums.fit_response()
            if last:
                break
            matrix = sums.solve(response.weights)[0]
            whitener = prediction_error_filter(*self._residuals(data, matrix, response), self.order)
        if not self.order:
            turbulence = self._residuals(data, sums.solve(response.weights)[0], response)
            self._spread = _spread(autocovariance(*turbulence, self.lags - 1), response.weights)
        self._whitener, self._response = whitener if self.order else np.ones(1), response

    def _residuals(
        self, data: Telemetry, matrix: NDArray[np.float64], response: TemporalResponse
    ) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
        """Slopes less what the pokes explain ``(n_times, n_slopes)``, and where they are known."""
        at = data.complete(0, self.lags)
        seen = sum(w * data.pokes[at - lag] for lag, w in enumerate(response.weights))
        residuals = np.zeros_like(data.slopes)
        residuals[at] = data.slopes[at] - seen @ matrix.T
        usable = np.zeros_like(data.present)
        usable[at] = True
        return residuals, usable


def _spread(noise: NDArray[np.float64], weights: NDArray[np.float64]) -> float:
    """Factor on the variance of the plain estimator, whose noise is not white.

    A poke that shows in several frames meets the same turbulence in all of them: ``sum over k of
    rho_noise(k) rho_poke(k)``, with the autocorrelations of the noise and of the poke as it is seen.
    """
    seen = np.correlate(weights, weights, "full")[weights.size - 1 :]
    if not noise[0] > 0:
        return 1.0
    terms = (noise / noise[0]) * (seen / seen[0])
    return float(max(1 + 2 * terms[1:].sum(), 0.0))
