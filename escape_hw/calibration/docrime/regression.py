"""Regression of slopes on pokes from sums over frames, by least squares or by instrumental variables.

In closed loop a command responds to the turbulence that the slopes contain, so least squares of slopes on
commands is biased. Pokes are independent of turbulence, noise and controller. With slopes ``y``, commands
``x`` and pokes ``z``, all of them whitened and the latter two as seen through the temporal response,

    sum y z^T = D sum x z^T + E ,    columns of E with covariance  var(y - D x) sum z z^T ,

for any controller (instrumental variables; Söderström & Stoica 1983), and ``D = (sum y z^T) (sum x z^T)^-1``.
In open loop ``x = z``, and this is least squares.

SPRINT fits the sums like a matrix: rotated onto the eigenvectors of ``sum z z^T`` their columns have equal
and independent errors. The controller's part of ``sum x z^T`` averages out only slowly, and until then it is
correlated with ``E``, because both contain the same turbulence; a fit to ``D sum x z^T`` would be drawn
towards the biased solution (weak instruments, Bound et al. 1995). The fit is therefore to ``D c sum z z^T``,
which depends on the pokes alone, after ``D (sum x z^T - c sum z z^T)`` was subtracted with the best known
``D``. The fixed point solves the instrumental equations themselves.
"""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from escape_hw.api.interaction_matrix import InteractionMatrix

#: Number of slopes whose correlations are always summed.
N_SAMPLED_SLOPES = 64
#: Number of slopes up to which the correlations of all of them are summed: the memory grows with its square.
MAX_CORRELATED_SLOPES = 3000
#: Directions in which the pokes had less than this share of the largest power are left out.
MIN_POWER_RATIO = 1e-9


@dataclass(slots=True, eq=False)
class InstrumentalEquations:
    """Sums over frames of an instrumental-variable regression; see the module.

    Parameters
    ----------
    cross
        ``sum y z^T`` ``(n_slopes, n_modes)``.
    command_poke_products
        ``sum x z^T`` ``(n_modes, n_modes)``.
    poke_products
        ``sum z z^T`` ``(n_modes, n_modes)``.
    """

    cross: NDArray[Any]
    command_poke_products: NDArray[Any]
    poke_products: NDArray[Any]

    @staticmethod
    def from_rows(slopes: NDArray[Any], commands: NDArray[Any], pokes: NDArray[Any]) -> InstrumentalEquations:
        """Sums of rows ``(n, n_slopes)``, ``(n, n_modes)`` and ``(n, n_modes)``."""
        return InstrumentalEquations(slopes.T @ pokes, commands.T @ pokes, pokes.T @ pokes)

    def solve(self, damping: float = 0.0) -> NDArray[Any]:
        """Matrix ``(n_slopes, n_modes)``; ``damping`` is relative to the mean diagonal of ``sum x z^T``."""
        products = self.command_poke_products
        if damping:
            products = products.copy()
            products[np.diag_indices_from(products)] += damping * np.trace(products) / len(products)
        return np.asarray(np.linalg.solve(products.T, self.cross.T).T)

    def information(self) -> NDArray[np.float64]:
        """``X Z^-1 X^T`` with ``X = sum x z^T`` and ``Z = sum z z^T``.

        Its inverse is the covariance of a row of the matrix, per variance of that slope's noise.
        """
        products, factor = self.command_poke_products, cho_factor(self.poke_products, check_finite=False)
        return np.asarray(products @ cho_solve(factor, products.T, check_finite=False))

    def poke_response(self, matrix: NDArray[Any], factor: float = 1.0) -> NDArray[Any]:
        """``sum y z^T`` less what a matrix attributes to the controller ``(n_slopes, n_modes)``.

        ``factor`` is the part of a poke that remains in the command after the loop's response to it.
        """
        return self.cross - matrix @ (self.command_poke_products - factor * self.poke_products)


@dataclass(slots=True, eq=False)
class RegressionSums:
    """Sums over frames for a least-squares regression, in memory that does not depend on their number.

    Parameters
    ----------
    cross
        Slopes times pokes ``(n_slopes, n_modes)``.
    gram
        Pokes times pokes ``(n_modes, n_modes)``.
    power
        Slopes times slopes ``(n_slopes, n_slopes)``, or its diagonal ``(n_slopes,)`` if the correlations
        between slopes are not needed.
    few
        Slopes times slopes of at most :data:`N_SAMPLED_SLOPES` evenly spaced slopes.
    slopes, pokes
        Sums of the slopes ``(n_slopes,)`` and of the pokes ``(n_modes,)``.
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
        self.power += _products(slopes, self.power.ndim)
        few = np.ascontiguousarray(slopes[:, :: sampling_step(slopes.shape[1])])
        self.few += few.T @ few
        ones = np.ones(len(slopes), np.float32)
        self.slopes += ones @ slopes
        self.pokes += ones @ pokes
        self.count += len(slopes)
        return self

    def subtract_means(self) -> Self:
        """Return the sums about the means of slopes and pokes."""
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

    def select_sampled(self) -> Self:
        """Return the sums for the sampled slopes alone, with their correlations."""
        step = sampling_step(self.slopes.size)
        return replace(self, cross=self.cross[::step], power=self.few, slopes=self.slopes[::step])

    def signal_power(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of squares of each column of the solved matrix without that of noise ``(n_modes,)``."""
        residual = self.residual_power(matrix)
        power = float(np.trace(residual) if residual.ndim == 2 else residual.sum())
        noise = power / self.degrees_of_freedom()
        return np.asarray(np.square(matrix).sum(axis=0) - noise * self.inverse_diagonal())

    def arrays(self) -> dict[str, NDArray[np.float64]]:
        """The arrays of the sums by name; views, through which they can be restored."""
        names = ("cross", "gram", "power", "few", "slopes", "pokes")
        return {name: getattr(self, name) for name in names}

    def information(self) -> NDArray[np.float64]:
        """Information on the modes ``(n_modes, n_modes)``.

        Its inverse is the covariance of a row of the matrix, per variance of that slope's noise.
        """
        return self.gram

    def degrees_of_freedom(self) -> float:
        """Expected power of the residuals over the variance of the noise."""
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
        """Sum of residuals times residuals for the solved matrix, of the shape of ``power``."""
        if self.power.ndim == 1:
            return np.asarray(self.power - np.einsum("sm,sm->s", self.cross, matrix))
        return np.asarray(self.power - self.cross @ matrix.T)

    def sample(self, matrix: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """The sampled rows of the solved matrix, and the sum of their residuals times residuals."""
        rows = matrix[:: sampling_step(len(matrix))]
        return rows, self.select_sampled().residual_power(rows)


class InstrumentalVariableSums(RegressionSums):
    """Sums for closed loop, with pokes as instruments of the commands; see the module.

    Rows are added with commands and pokes side by side ``(n, 2 n_modes)``, so ``cross`` and ``gram`` have
    twice as many columns.
    """

    def information(self) -> NDArray[np.float64]:
        """As :meth:`InstrumentalEquations.information`."""
        return self._equations().information()

    def degrees_of_freedom(self) -> float:
        """Expected power of the residuals over the variance of the noise.

        For ``sum |y - D x|^2`` it is ``N - 2 m + tr(sum x x^T (X Z^-1 X^T)^-1)``.
        """
        commands = self._command_products()
        return float(self.count - 2 * len(commands) + np.trace(np.linalg.solve(self.information(), commands)))

    def solve(self) -> NDArray[np.float64]:
        """Instrumental-variable matrix ``(n_slopes, n_modes)``."""
        return self._equations().solve()

    def residual_power(self, matrix: NDArray[np.float64]) -> NDArray[np.float64]:
        """Sum of residuals times residuals, of the shape of ``power``."""
        cross, gram = self.cross[:, : matrix.shape[1]], self._command_products()
        if self.power.ndim == 1:
            explained = np.einsum("sm,sm->s", matrix @ gram, matrix)
            return np.asarray(self.power - 2 * np.einsum("sm,sm->s", cross, matrix) + explained)
        cross_products = cross @ matrix.T
        return np.asarray(self.power - cross_products - cross_products.T + matrix @ gram @ matrix.T)

    def _command_products(self) -> NDArray[np.float64]:
        """``sum x x^T`` ``(n_modes, n_modes)``."""
        m = len(self.gram) // 2
        return self.gram[:m, :m]

    def _equations(self) -> InstrumentalEquations:
        m = len(self.gram) // 2
        return InstrumentalEquations(self.cross[:, m:], self.gram[:m, m:], self.gram[m:, m:])


@dataclass(slots=True, eq=False)
class ForgettingSums(InstrumentalEquations):
    """Exponentially forgotten instrumental-variable sums; ``w`` is the weight of a frame.

    Parameters
    ----------
    cross, command_poke_products, poke_products
        ``sum w y z^T``, ``sum w x z^T`` and ``sum w z z^T``.
    gram
        ``sum w^2 z z^T`` ``(n_modes, n_modes)``: covariance of the errors of ``cross``, per variance of the
        noise.
    residual_products
        ``sum w e e^T`` of the residual ``e = y - D x`` ``(n_slopes, n_slopes)``, or its diagonal
        ``(n_slopes,)`` above :data:`MAX_CORRELATED_SLOPES` slopes.
    weight
        ``sum w``.
    """

    gram: NDArray[np.float64]
    residual_products: NDArray[np.float64]
    weight: float = 0.0

    @classmethod
    def zeros(cls, n_slopes: int, n_modes: int) -> ForgettingSums:
        """Empty sums."""
        square = (n_slopes, n_slopes) if n_slopes <= MAX_CORRELATED_SLOPES else (n_slopes,)
        products, poke_products, gram = np.zeros((3, n_modes, n_modes))
        return cls(np.zeros((n_slopes, n_modes)), products, poke_products, gram, np.zeros(square))

    def forget(self, factor: float) -> None:
        """Multiply the weights of all frames so far by ``factor``."""
        for array in (self.cross, self.command_poke_products, self.poke_products, self.residual_products):
            array *= factor
        self.gram *= factor**2
        self.weight *= factor

    def add(
        self,
        slopes: NDArray[np.float32],
        command: NDArray[np.float32],
        poke: NDArray[np.float32],
        matrix: NDArray[np.float32],
    ) -> None:
        """Add a block of whitened frames with weight 1.

        Parameters
        ----------
        slopes, command, poke
            ``y (n, n_slopes)``, ``x (n, n_modes)`` and ``z (n, n_modes)``. Their means over the block, which
            are static aberrations, are subtracted.
        matrix
            The best known matrix ``(n_slopes, n_modes)``, for the residual.
        """
        y, x, z = (part - part.mean(axis=0) for part in (slopes, command, poke))
        residual = y - x @ matrix.T
        sums = InstrumentalEquations.from_rows(y, x, z)
        residual_products = _products(residual, self.residual_products.ndim)
        self.merge(
            ForgettingSums(
                sums.cross, sums.command_poke_products, sums.poke_products, sums.poke_products,
                residual_products, len(y),
            )
        )  # fmt: skip

    def merge(self, other: ForgettingSums) -> None:
        """Add the sums of other frames."""
        for field in fields(self):
            if field.name != "weight":
                array = getattr(self, field.name)
                array += getattr(other, field.name)
        self.weight += other.weight

    @property
    def covariance(self) -> NDArray[np.float64] | None:
        """Covariance of one frame's residual ``(n_slopes, n_slopes)``; ``None`` with too many slopes."""
        return self.residual_products / self.weight if self.residual_products.ndim == 2 else None

    @property
    def variance(self) -> NDArray[np.float64]:
        """Variance of one frame's residual ``(n_slopes,)``."""
        products = self.residual_products
        return np.asarray((np.diag(products) if products.ndim == 2 else products) / self.weight)

    def build_columns(self, template: InteractionMatrix, matrix: NDArray[np.float64]) -> InteractionMatrix:
        """Build a matrix from the sums whose columns have equal, independent errors.

        ``matrix``: the best known matrix ``(n_slopes, n_modes)``, for the controller's part.

        Returns ``(n_slopes, rank)``, its modes rotated and not of unit rms.
        """
        factor = float(np.median(np.diag(self.command_poke_products) / np.diag(self.poke_products)))
        cross = self.poke_response(matrix, factor)
        return whiten_columns(template, cross, factor * self.poke_products, self.gram, self.variance)


def whiten_columns(
    template: InteractionMatrix,
    cross: NDArray[np.float64],
    command_poke_products: NDArray[np.float64],
    gram: NDArray[np.float64],
    variance: NDArray[np.float64],
) -> InteractionMatrix:
    """Rotate and scale sums so that their columns have equal, independent errors; see the module.

    Parameters
    ----------
    template
        Any matrix of this sensor and basis, for mask, basis and provenance.
    cross, command_poke_products, gram
        As for :class:`ForgettingSums`.
    variance
        Variance of each slope's whitened noise in one frame ``(n_slopes,)``.
    """
    power, directions = np.linalg.eigh(gram)
    significant = power > MIN_POWER_RATIO * power.max()
    transform = directions[:, significant] / np.sqrt(power[significant])
    sigma = np.repeat(np.sqrt(variance)[:, None], transform.shape[1], axis=1)
    return replace(
        template,
        data=(cross @ transform).astype(np.float32),
        sigma=sigma.astype(np.float32),
        m2c=template.m2c @ (command_poke_products @ transform),
    )


def _products(rows: NDArray[Any], dimensions: int) -> NDArray[Any]:
    """Sum over rows ``(n, n_columns)`` of their outer products, or the diagonal of it in one dimension."""
    return np.asarray(rows.T @ rows if dimensions == 2 else np.einsum("ts,ts->s", rows, rows))


def sampling_step(n_slopes: int) -> int:
    """Distance between the sampled slopes."""
    return max(1, -(-n_slopes // N_SAMPLED_SLOPES))
