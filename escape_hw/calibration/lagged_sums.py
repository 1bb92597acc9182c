"""Sufficient statistics of a regression of slopes on the last few pokes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.whitening import apply_filter


@dataclass(slots=True, eq=False)
class LaggedSums:
    """Sums over frames, in memory that does not grow with their number.

    ``cross[l]`` is the sum of slopes times pokes ``l`` frames earlier ``(n_slopes, n_modes)``,
    ``gram[l, k]`` that of pokes times pokes ``(n_modes, n_modes)``, ``power`` that of slopes times
    slopes; all of filtered values, with their means taken out by :meth:`centred`.
    """

    cross: NDArray[np.float64]
    gram: NDArray[np.float64]
    power: NDArray[np.float64]
    slopes: NDArray[np.float64]
    pokes: NDArray[np.float64]
    count: int = 0

    @classmethod
    def zeros(cls, n_slopes: int, n_modes: int, lags: int) -> LaggedSums:
        """Empty sums."""
        return cls(
            np.zeros((lags, n_slopes, n_modes)),
            np.zeros((lags, n_modes, lags, n_modes)),
            np.zeros((n_slopes, n_slopes)),
            np.zeros(n_slopes),
            np.zeros((lags, n_modes)),
        )

    @property
    def lags(self) -> int:
        """Number of lags."""
        return int(self.cross.shape[0])

    def add(
        self,
        data: Telemetry,
        whitener: NDArray[np.float64],
        start: int = 0,
        response: NDArray[np.float64] | None = None,
    ) -> None:
        """Add every complete row from ``start`` on.

        Single precision carries the products within a block (as the slopes themselves do), double
        precision the sums over blocks.

        Parameters
        ----------
        data
            Filter and response look back into its first rows.
        whitener
            Filter over time, applied to slopes and pokes alike.
        response
            A known temporal response; the sums then have one lag, of pokes seen through it.
        """
        reach = self.lags if response is None else response.size
        at = data.complete(whitener.size - 1, reach + whitener.size - 1)
        at = at[at >= start]
        if not at.size:
            return
        if response is None:
            kernels = [np.concatenate([np.zeros(lag), whitener]) for lag in range(self.lags)]
        else:
            kernels = [np.convolve(whitener, response)]
        y = apply_filter(data.slopes, whitener, at)
        x = np.concatenate([apply_filter(data.pokes, kernel, at) for kernel in kernels], axis=1)
        shape = (self.lags, self.cross.shape[2])
        self.gram += (x.T @ x).reshape(*shape, *shape)
        self.cross += (y.T @ x).reshape(-1, *shape).transpose(1, 0, 2)
        self.power += y.T @ y
        self.slopes += y.sum(axis=0)
        self.pokes += x.sum(axis=0).reshape(shape)
        self.count += at.size

    def centred(self) -> LaggedSums:
        """The same sums about the means of slopes and pokes."""
        n = max(self.count, 1)
        return LaggedSums(
            self.cross - self.slopes[None, :, None] * self.pokes[:, None, :] / n,
            self.gram - np.multiply.outer(self.pokes, self.pokes) / n,
            self.power - np.outer(self.slopes, self.slopes) / n,
            np.zeros_like(self.slopes),
            np.zeros_like(self.pokes),
            self.count,
        )

    def solve(self, weights: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Least-squares matrix for a given temporal response.

        Parameters
        ----------
        weights
            Temporal response ``(lags,)``.

        Returns
        -------
        matrix : ndarray, ``(n_slopes, n_modes)``
        gram : ndarray, ``(n_modes, n_modes)``
            Normal matrix; its inverse times a slope's variance is the covariance of that row.
        """
        gram = np.einsum("l,lmkn,k->mn", weights, self.gram, weights, optimize=True)
        cross = np.einsum("l,lsm->sm", weights, self.cross)
        return np.linalg.solve(gram, cross.T).T, gram

    def residual_power(
        self, matrix: NDArray[np.float64], weights: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Sum of residuals times residuals ``(n_slopes, n_slopes)`` for a solution."""
        gram = np.einsum("l,lmkn,k->mn", weights, self.gram, weights, optimize=True)
        cross = np.einsum("l,lsm->sm", weights, self.cross)
        both = cross @ matrix.T
        return np.asarray(self.power - both - both.T + matrix @ gram @ matrix.T)

    def response_to(self, matrix: NDArray[np.float64]) -> TemporalResponse:
        """Temporal response given a matrix, scaled to sum 1, with standard errors."""
        normal = np.einsum("mn,lnkm->lk", matrix.T @ matrix, self.gram, optimize=True)
        right = np.einsum("sm,lsm->l", matrix, self.cross)
        weights = np.linalg.solve(normal, right)
        noise = np.maximum(np.diag(self.residual_power(matrix, weights)), 0) / max(self.count, 1)
        # The regressor of lag l is matrix @ poke: its noise is the slopes', weighted by the matrix.
        rows = np.square(matrix).sum(axis=1)
        variance = float(noise @ rows / rows.sum())
        total = weights.sum()
        sigma = np.sqrt(variance * np.diag(np.linalg.inv(normal))) / abs(total)
        return TemporalResponse(weights / total, sigma)

    def fit_response(self, rounds: int = 20) -> TemporalResponse:
        """Temporal response and matrix together, by alternating least squares.

        Starts from the lag that explains most and stops when the response moves by less than 1e-4.
        """
        powers = []
        for lag in range(self.lags):
            matrix, gram = self.solve(np.eye(self.lags)[lag])
            powers.append(float(np.einsum("sm,mn,sn->", matrix, gram, matrix, optimize=True)))
        response = TemporalResponse(np.eye(self.lags)[int(np.argmax(powers))], np.zeros(self.lags))
        for _ in range(rounds):
            update = self.response_to(self.solve(response.weights)[0])
            moved = float(np.abs(update.weights - response.weights).max())
            response = update
            if moved < 1e-4:
                break
        return response
