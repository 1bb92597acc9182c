"""Sufficient statistics of a linear regression of slopes on pokes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

#: Slopes whose correlations are always known.
FEW = 64


@dataclass(slots=True, eq=False)
class RegressionSums:
    """Sums over frames, in memory that does not grow with their number.

    ``cross`` is the sum of slopes times pokes ``(n_slopes, n_modes)``, ``gram`` that of pokes times
    pokes, ``power`` that of slopes times slopes: ``(n_slopes, n_slopes)``, or its diagonal
    ``(n_slopes,)`` where correlations between slopes are not asked for. ``few`` is the whole of it for
    some slopes, evenly spread.
    """

    cross: NDArray[np.float64]
    gram: NDArray[np.float64]
    power: NDArray[np.float64]
    few: NDArray[np.float64]
    slopes: NDArray[np.float64]
    pokes: NDArray[np.float64]
    count: int = 0

    @classmethod
    def zeros(cls, n_slopes: int, n_modes: int, *, correlations: bool) -> RegressionSums:
        """Empty sums."""
        n_few = len(range(0, n_slopes, _step(n_slopes)))
        return cls(
            np.zeros((n_slopes, n_modes)),
            np.zeros((n_modes, n_modes)),
            np.zeros((n_slopes, n_slopes) if correlations else n_slopes),
            np.zeros((n_few, n_few)),
            np.zeros(n_slopes),
            np.zeros(n_modes),
        )

    def add(self, slopes: NDArray[np.float32], pokes: NDArray[np.float32]) -> RegressionSums:
        """Add rows ``(n, n_slopes)`` and ``(n, n_modes)``.

        Single precision carries the products within a block (as the slopes themselves do), double
        precision the sums over blocks.
        """
        self.cross += slopes.T @ pokes
        self.gram += pokes.T @ pokes
        self.power += slopes.T @ slopes if self.power.ndim == 2 else np.einsum("ts,ts->s", slopes, slopes)
        few = np.ascontiguousarray(slopes[:, :: _step(slopes.shape[1])])
        self.few += few.T @ few
        ones = np.ones(len(slopes), np.float32)
        self.slopes += ones @ slopes
        self.pokes += ones @ pokes
        self.count += len(slopes)
        return self

    def centred(self) -> RegressionSums:
        """The same sums about the means of slopes and pokes."""
        n = max(self.count, 1)
        few = self.slopes[:: _step(self.slopes.size)]
        square = np.outer(self.slopes, self.slopes) if self.power.ndim == 2 else np.square(self.slopes)
        return RegressionSums(
            self.cross - np.outer(self.slopes, self.pokes) / n,
            self.gram - np.outer(self.pokes, self.pokes) / n,
            self.power - square / n,
            self.few - np.outer(few, few) / n,
            np.zeros_like(self.slopes),
            np.zeros_like(self.pokes),
            self.count,
        )

    def solve(self) -> NDArray[np.float64]:
        """Least-squares matrix ``(n_slopes, n_modes)``."""
        return np.asarray(cho_solve(self._factor(), self.cross.T, check_finite=False).T)

    def inverse_diagonal(self) -> NDArray[np.float64]:
        """Diagonal of the inverse of ``gram`` ``(n_modes,)``."""
        whole = cho_solve(self._factor(), np.eye(len(self.gram)), check_finite=False)
        return np.asarray(np.diag(whole))

    def _factor(self) -> tuple[NDArray[np.float64], bool]:
        return cho_factor(self.gram, check_finite=False)  # type: ignore[no-any-return]

    def residual_power(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of residuals times residuals for the least-squares matrix, of the shape of ``power``."""
        if self.power.ndim == 1:
            return np.asarray(self.power - np.einsum("sm,sm->s", self.cross, matrix))
        return np.asarray(self.power - self.cross @ matrix.T)

    def sample(self, matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Some rows of the least-squares matrix, and the sum of their residuals times residuals."""
        step = _step(len(matrix))
        return matrix[::step], np.asarray(self.few - self.cross[::step] @ matrix[::step].T)


def _step(n_slopes: int) -> int:
    return max(1, -(-n_slopes // FEW))
