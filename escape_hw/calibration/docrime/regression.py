"""Sufficient statistics of a linear regression of slopes on pokes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

#: Slopes whose correlations are always known.
N_SAMPLED_SLOPES = 64


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
    def zeros(cls, n_slopes: int, n_modes: int, *, correlations: bool) -> Self:
        """Empty sums."""
        n_few = len(range(0, n_slopes, sampling_step(n_slopes)))
        return cls(
            np.zeros((n_slopes, n_modes)),
            np.zeros((n_modes, n_modes)),
            np.zeros((n_slopes, n_slopes) if correlations else n_slopes),
            np.zeros((n_few, n_few)),
            np.zeros(n_slopes),
            np.zeros(n_modes),
        )

    def add(self, slopes: NDArray[np.float32], pokes: NDArray[np.float32]) -> Self:
        """Add rows ``(n, n_slopes)`` and ``(n, n_modes)``.

        Single precision carries the products within a block (as the slopes themselves do), double
        precision the sums over blocks.
        """
        self.cross += slopes.T @ pokes
        self.gram += pokes.T @ pokes
        self.power += slopes.T @ slopes if self.power.ndim == 2 else np.einsum("ts,ts->s", slopes, slopes)
        few = np.ascontiguousarray(slopes[:, :: sampling_step(slopes.shape[1])])
        self.few += few.T @ few
        ones = np.ones(len(slopes), np.float32)
        self.slopes += ones @ slopes
        self.pokes += ones @ pokes
        self.count += len(slopes)
        return self

    def subtract_means(self) -> Self:
        """The same sums about the means of slopes and pokes."""
        n = max(self.count, 1)
        few = self.slopes[:: sampling_step(self.slopes.size)]
        square = np.outer(self.slopes, self.slopes) if self.power.ndim == 2 else np.square(self.slopes)
        return type(self)(
            self.cross - np.outer(self.slopes, self.pokes) / n,
            self.gram - np.outer(self.pokes, self.pokes) / n,
            self.power - square / n,
            self.few - np.outer(few, few) / n,
            np.zeros_like(self.slopes),
            np.zeros_like(self.pokes),
            self.count,
        )

    def centred_sample(self) -> Self:
        """The same sums about the means for the few slopes alone; costs little."""
        step = sampling_step(self.slopes.size)
        few, n = self.slopes[::step], max(self.count, 1)
        power = self.few - np.outer(few, few) / n
        return type(self)(
            self.cross[::step] - np.outer(few, self.pokes) / n,
            self.gram - np.outer(self.pokes, self.pokes) / n,
            power, power, np.zeros_like(few), np.zeros_like(self.pokes), self.count,
        )  # fmt: skip

    def signal_power(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of squares of each column of the least-squares matrix, less what noise adds ``(n_modes,)``."""
        residual = self.residual_power(matrix)
        noise = (
            float(np.trace(residual) if residual.ndim == 2 else residual.sum()) / self.degrees_of_freedom()
        )
        return np.asarray(np.square(matrix).sum(axis=0) - noise * self.inverse_diagonal())

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """All sums by name, themselves and no copies: written into, they are restored."""
        names = ("cross", "gram", "power", "few", "slopes", "pokes")
        return {name: getattr(self, name) for name in names}

    def information(self) -> NDArray[np.float64]:
        """What the frames tell of the modes ``(n_modes, n_modes)``.

        Its inverse is the covariance of a row of the matrix, per variance of that slope's noise.
        """
        return self.gram

    def degrees_of_freedom(self) -> float:
        """Degrees of freedom of the residuals: their power over the noise's variance, expected."""
        return float(self.count - len(self.gram))

    def solve(self) -> NDArray[np.float64]:
        """Least-squares matrix ``(n_slopes, n_modes)``."""
        factor = cho_factor(self.gram, check_finite=False)
        return np.asarray(cho_solve(factor, self.cross.T, check_finite=False).T)

    def inverse_diagonal(self) -> NDArray[np.float64]:
        """Diagonal of the inverse of the information ``(n_modes,)``."""
        information = self.information()
        inverse = cho_solve(cho_factor(information, check_finite=False), np.eye(len(information)))
        return np.asarray(np.diag(inverse))

    def residual_power(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of residuals times residuals for the least-squares matrix, of the shape of ``power``."""
        if self.power.ndim == 1:
            return np.asarray(self.power - np.einsum("sm,sm->s", self.cross, matrix))
        return np.asarray(self.power - self.cross @ matrix.T)

    def sample(self, matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Some rows of the least-squares matrix, and the sum of their residuals times residuals."""
        step = sampling_step(len(matrix))
        return matrix[::step], np.asarray(self.few - self.cross[::step] @ matrix[::step].T)


class InstrumentalVariableSums(RegressionSums):
    """The same sums with pokes as instruments of the commands they are part of.

    In closed loop a command answers the turbulence that the slopes show, and least squares would take
    part of the turbulence for a response. Pokes know nothing of it: with slopes ``y``, commands ``x``
    and pokes ``z``, ``D = (sum y z^T) (sum x z^T)^-1`` (instrumental variables; Söderström & Stoica
    1983), whatever the controller does. Rows are added with ``x`` and ``z`` side by side
    ``(n, 2 n_modes)``.
    """

    def information(self) -> NDArray[np.float64]:
        """``X Z^-1 X^T`` with ``X = sum x z^T`` and ``Z = sum z z^T``."""
        _, link, pokes = self._split_gram()
        return np.asarray(link @ cho_solve(cho_factor(pokes, check_finite=False), link.T, check_finite=False))

    def degrees_of_freedom(self) -> float:
        """As least squares has them, and what the commands' own motion adds to the residuals.

        ``sum |y - D x|^2`` is ``N - 2 m + tr(sum x x^T (X Z^-1 X^T)^-1)`` variances of the noise.
        """
        commands, link, _ = self._split_gram()
        return float(self.count - 2 * len(link) + np.trace(np.linalg.solve(self.information(), commands)))

    def solve(self) -> NDArray[np.float64]:
        """The matrix ``(n_slopes, n_modes)``."""
        _, link, _ = self._split_gram()
        return np.asarray(np.linalg.solve(link.T, self.cross[:, len(link) :].T).T)

    def residual_power(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of residuals times residuals, of the shape of ``power``."""
        return _residual_power(self.power, self.cross[:, : matrix.shape[1]], self._split_gram()[0], matrix)

    def sample(self, matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Some rows of the matrix, and the sum of their residuals times residuals."""
        step = sampling_step(len(matrix))
        rows, cross = matrix[::step], self.cross[::step, : matrix.shape[1]]
        return rows, _residual_power(self.few, cross, self._split_gram()[0], rows)

    def _split_gram(self) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """``sum x x^T``, ``sum x z^T`` and ``sum z z^T``."""
        m = len(self.gram) // 2
        return self.gram[:m, :m], self.gram[:m, m:], self.gram[m:, m:]


def _residual_power(
    power: NDArray[np.float64],
    cross: NDArray[np.float64],
    gram: NDArray[np.float64],
    matrix: NDArray[np.float64],
) -> NDArray[np.float64]:
    """``sum (y - D x) (y - D x)^T`` from its parts, or the diagonal of it."""
    if power.ndim == 1:
        return np.asarray(
            power - 2 * np.einsum("sm,sm->s", cross, matrix) + np.einsum("sm,sm->s", matrix @ gram, matrix)
        )
    cross_products = cross @ matrix.T
    return np.asarray(power - cross_products - cross_products.T + matrix @ gram @ matrix.T)


def sampling_step(n_slopes: int) -> int:
    """From one slope to the next of those whose correlations are always known."""
    return max(1, -(-n_slopes // N_SAMPLED_SLOPES))
