"""Priors and normal equations of the mixed-effects fit.

SPRINT fits the differences between the real system and the synthetic model as random effects beside the
registration. Each effect has a prior, of zero mean but after an earlier fit, with its scatter among
instruments of a kind, so that the data decide its size and the errors of the registration include it.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import lu_factor, lu_solve

from escape_hw.api.results import ActuatorCorrections

#: Slopes whose products with all common parameters are in memory at once.
_SLOPES_AT_ONCE = 256


@dataclass(frozen=True, slots=True)
class Priors:
    """Prior scatter of the random effects, relative (rms).

    Parameters
    ----------
    actuator_gain
        Gains of single actuators.
    actuator_width
        Widths of single influence functions.
    actuator_position
        Positions of single actuators along each axis, in % of a sub-aperture.
    slope_gain
        Gains of single slopes: uneven light, spot size and alignment with the pixels.
    sampling
        Position within its lenslet at which a slope samples the wavefront, in % of a sub-aperture; common
        to the x slopes of a column and to the y slopes of a row, which have the same alignment with the
        pixels.
    width
        Common width of the influence functions.
    shape_scale
        Scatter of the coefficients of their shape, relative to that of
        :class:`~.influence_shape.InfluenceShape`.
    mean_width
        Prior mean of the relative width beyond nominal: zero, or the value of an earlier fit.
    actuators
        Corrections of an earlier fit: prior means of the shape and of the effects of single actuators, which
        are zero without it.
    extras
        Prior mean and scatter of each extra parameter, in units of its default scatter; zero and one where
        none are given.
    noise_inflation
        Variance of the noise projected on the slopes of an actuator, relative to independent noise of the
        same slopes. The fit assumes independent noise; the prior precision of the actuator gains is
        multiplied by this factor instead.
    """

    actuator_gain: float = 0.1
    actuator_width: float = 0.05
    actuator_position: float = 5.0
    slope_gain: float = 0.1
    width: float = 0.2
    shape_scale: float = 1.0
    sampling: float = 0.5
    mean_width: float = 0.0
    actuators: ActuatorCorrections | None = None
    extras: tuple[tuple[float, float], ...] = ()
    noise_inflation: float = 1.0


@dataclass(slots=True, eq=False)
class NormalEquations:
    """Gauss-Newton system of one linearisation, in units of the data's standard errors.

    The unknowns are, in order: the common parameters (gain, five of the registration, width, shape,
    shares of the model's variants), sampling positions, trends of the slope gains, the effects of the
    actuators (all of one kind, then those of the next), slope gains.
    The gain of a slope affects no other slope, so that block is diagonal and is eliminated first.

    Parameters
    ----------
    inner
        Normal matrix of all unknowns but the slope gains ``(n_inner, n_inner)``.
    coupling
        Its coupling with the slope gains ``(n_slopes, n_inner)``.
    diagonal
        The block of the slope gains ``(n_slopes,)``.
    schur_complement
        ``inner`` with the slope gains eliminated.
    right_hand_side
        Of the whole system.
    common, sampling_derivative, actuator_derivatives, modes, model, residual, lines, trends, precision
        Arguments of :func:`normal_equations`.
    """

    inner: NDArray[np.float64]
    coupling: NDArray[np.float64]
    diagonal: NDArray[np.float64]
    schur_complement: NDArray[np.float64]
    right_hand_side: NDArray[np.float64]
    common: NDArray[np.float64]
    sampling_derivative: NDArray[np.float64]
    actuator_derivatives: NDArray[np.float64]
    modes: NDArray[np.float64]
    model: NDArray[np.float64]
    residual: NDArray[np.float64]
    lines: NDArray[np.intp]
    trends: NDArray[np.float64]
    precision: NDArray[np.float64]
    _elimination: tuple[Any, NDArray[np.float64]] | None = None

    @property
    def n_common(self) -> int:
        """Number of common parameters."""
        return len(self.common)

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The full normal matrix."""
        return np.block([[self.inner, self.coupling.T], [self.coupling, np.diag(self.diagonal)]])

    def update(
        self, residual: NDArray[np.float64], precision: NDArray[np.float64], offset: NDArray[np.float64]
    ) -> NormalEquations:
        """The same derivatives with another residual and other priors, as for :func:`normal_equations`."""
        n, changes = len(self.inner), precision - self.precision
        system = self
        if changes.any():
            inner, diagonal = self.inner.copy(), self.diagonal + changes[n:]
            inner[np.diag_indices(n)] += changes[:n]
            schur_complement = _eliminate_slope_gains(inner, self.coupling, diagonal)
            system = replace(
                self, inner=inner, diagonal=diagonal, schur_complement=schur_complement, precision=precision,
                _elimination=None,
            )  # fmt: skip
        return replace(system, residual=residual, right_hand_side=self._scores(residual) - precision * offset)

    def _scores(self, residual: NDArray[np.float64]) -> NDArray[np.float64]:
        """Products of all derivatives with a residual, in the order of the unknowns."""
        score = np.einsum("sm,sm->s", self.model, residual)
        by_slope = np.einsum("sm,sm->s", self.sampling_derivative, residual)
        by_actuator = np.einsum("zsa,sa->za", self.actuator_derivatives, residual @ self.modes.T)
        return np.concatenate([
            self.common.reshape(self.n_common, -1) @ residual.ravel(),
            np.bincount(self.lines, by_slope, self.n_lines)[: self.n_lines],
            score @ self.trends, by_actuator.ravel(), score,
        ])  # fmt: skip

    @property
    def n_lines(self) -> int:
        """Number of sampling positions."""
        n_kinds, _, n_act = self.actuator_derivatives.shape
        return int(len(self.inner) - self.n_common - self.trends.shape[1] - n_kinds * n_act)

    def _eliminate_effects(self) -> tuple[Any, NDArray[np.float64]]:
        """LU factors of the block of the effects, and its solution for their coupling with the common."""
        if self._elimination is None:
            k = self.n_common
            factors = lu_factor(self.schur_complement[k:, k:])
            self._elimination = factors, lu_solve(factors, self.schur_complement[k:, :k])
        return self._elimination

    def solve(self) -> NDArray[np.float64]:
        """The Gauss-Newton step, in the order of the unknowns."""
        k, n = self.n_common, len(self.inner)
        scaled = self.right_hand_side[n:] / self.diagonal
        right = self.right_hand_side[:n] - self.coupling.T @ scaled
        factors, by_common = self._eliminate_effects()
        common = np.linalg.solve(self.information(), right[:k] - right[k:] @ by_common)
        first = np.concatenate([common, lu_solve(factors, right[k:]) - by_common @ common])
        return np.concatenate([first, scaled - self.coupling @ first / self.diagonal])

    def solve_damped(self, damping: float, offset: NDArray[np.float64]) -> NDArray[np.float64]:
        """The step with all prior precisions multiplied by ``1 + damping``, about the present state.

        Parameters
        ----------
        damping
            Not negative; with 0 it is :meth:`solve`.
        offset
            Present value of every unknown minus its prior mean, as in :func:`normal_equations`.
        """
        return self.update(self.residual, (1 + damping) * self.precision, offset / (1 + damping)).solve()

    def information(self) -> NDArray[np.float64]:
        """Information on the common parameters ``(n_common, n_common)``, random effects integrated out."""
        k, schur_complement = self.n_common, self.schur_complement
        return np.asarray(schur_complement[:k, :k] - schur_complement[:k, k:] @ self._eliminate_effects()[1])

    def noise_covariance(self, precision: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance of the common parameters due to the noise alone ``(n_common, n_common)``.

        The inverse of :meth:`information` also contains the uncertainty due to the priors, which is the
        same in every repetition.

        Parameters
        ----------
        precision
            Prior precision of every unknown, as in :func:`normal_equations`.
        """
        k, n = self.n_common, len(self.inner)
        inverse_columns = np.linalg.inv(self.schur_complement)[:, :k]
        by_slope = self.coupling @ inverse_columns / self.diagonal[:, None]
        prior_part = inverse_columns.T @ (precision[:n, None] * inverse_columns) + by_slope.T @ (
            precision[n:, None] * by_slope
        )
        return np.asarray(inverse_columns[:k] - prior_part)

    def posterior_variance(self) -> NDArray[np.float64]:
        """Variance of every unknown given the data and the priors ``(n,)``, in the order of the unknowns."""
        inverse = np.linalg.inv(self.schur_complement)
        coupled = self.coupling / self.diagonal[:, None]
        of_slopes = 1 / self.diagonal + np.einsum("sp,sp->s", coupled @ inverse, coupled)
        return np.concatenate([np.diag(inverse), of_slopes])

    def projected_jacobian(self) -> NDArray[np.float64]:
        """Derivatives by the common parameters, projected orthogonally to the random effects.

        Returns
        -------
        ndarray, ``(n_common, n_slopes, n_modes)``
        """
        k, n_lines = self.n_common, self.n_lines
        n_kinds, n_slopes, n_act = self.actuator_derivatives.shape
        effects = self._eliminate_effects()[1]
        by_slope = (self.coupling[:, :k] - self.coupling[:, k:] @ effects) / self.diagonal[:, None]
        by_line, by_trend, by_actuator = np.split(effects, np.cumsum([n_lines, self.trends.shape[1]]))
        weights = by_actuator.reshape(n_kinds, n_act, k).transpose(2, 0, 1)
        by_model = by_slope + self.trends @ by_trend
        out = np.empty_like(self.common)
        acting = np.empty((n_slopes, n_act))
        for p in range(k):
            np.einsum("zsa,za->sa", self.actuator_derivatives, weights[p], out=acting)
            np.matmul(acting, self.modes, out=out[p])
            np.subtract(self.common[p], out[p], out=out[p])
            out[p] -= by_model[:, p, None] * self.model
            if n_lines:
                out[p] -= by_line[self.lines, p, None] * self.sampling_derivative
        return out

    def estimate_noise_inflation(self) -> float:
        """Estimate :attr:`Priors.noise_inflation` from the residual, misfit included; at least 1.

        Turbulence correlates the noise of neighbouring slopes, so it does not average out over the slopes
        of an actuator. The columns have independent noise, so the factor follows from their scatter.
        """
        gain_derivative = self.actuator_derivatives[0]
        observed = float(np.square(gain_derivative.T @ self.residual).sum())
        independent = float(np.square(gain_derivative).sum()) * self.residual.shape[1]
        return float(max(observed / max(independent, 1e-300), 1.0))


def normal_equations(
    common: NDArray[np.float64],
    actuator_derivatives: NDArray[np.float64],
    modes: NDArray[np.float64],
    model: NDArray[np.float64],
    residual: NDArray[np.float64],
    precision: NDArray[np.float64],
    offset: NDArray[np.float64],
    sampling_derivative: NDArray[np.float64] | None = None,
    lines: NDArray[np.intp] | None = None,
    trends: NDArray[np.float64] | None = None,
    mean_precision: float = 0.0,
) -> NormalEquations:
    """Assemble the system without forming the derivatives by all unknowns.

    Parameters
    ----------
    common
        Weighted derivatives by the common parameters ``(n_common, n_slopes, n_modes)``.
    actuator_derivatives
        Weighted zonal matrices ``(n_kinds, n_slopes, n_act)``: the derivative by an effect of an actuator,
        such as its gain (the first kind), is the outer product of its column and its row of ``modes``.
    modes
        Weighted mode-to-command matrix ``(n_act, n_modes)``.
    model, residual
        Weighted model and residual ``(n_slopes, n_modes)``.
    precision
        Prior precision of every unknown.
    offset
        Present value of every unknown minus its prior mean.
    sampling_derivative, lines
        Weighted derivatives of each slope by its sampling position ``(n_slopes, n_modes)``, and the index
        of the line of sub-apertures ``(n_slopes,)`` that shares that position; none by default.
    trends
        Changes of the slope gains per trend ``(n_slopes, n_trends)``; none by default.
    mean_precision
        Precision of the sum of the actuator effects of the first kind, about its present value; 0: free.
    """
    if trends is None:
        trends = np.zeros((len(model), 0))
    if sampling_derivative is None or lines is None:
        sampling_derivative, lines = np.zeros_like(model), np.zeros(len(model), np.intp)
        member = np.zeros((len(model), 0))
    else:
        member = (lines[:, None] == np.arange(lines.max() + 1)).astype(float)
    k, n_kinds = len(common), len(actuator_derivatives)
    # All kinds side by side, so that products are few and large.
    zonal = np.concatenate(list(actuator_derivatives), axis=1)
    acting = (zonal.T @ zonal) * np.tile(modes @ modes.T, (n_kinds, n_kinds))
    common_line = np.einsum("psm,sm->ps", common, sampling_derivative) @ member
    line_acting = member.T @ (np.tile(sampling_derivative @ modes.T, n_kinds) * zonal)
    line = np.diag(np.einsum("sm,sm->s", sampling_derivative, sampling_derivative) @ member)
    by_line = member * np.einsum("sm,sm->s", model, sampling_derivative)[:, None]
    by_acting = np.tile(model @ modes.T, n_kinds) * zonal
    power = np.einsum("sm,sm->s", model, model)
    # A trend is a linear combination of slope gains, so its products follow from theirs.
    by_trend = trends * power[:, None]
    coupling = np.concatenate([np.einsum("sm,psm->sp", model, common), by_line, by_trend, by_acting], axis=1)
    common_trend, line_trend, trend_trend, trend_acting = np.split(
        trends.T @ coupling, np.cumsum([k, member.shape[1], trends.shape[1]]), axis=1
    )
    flat, common_acting = common.reshape(k, -1), _common_products(common, actuator_derivatives, modes)
    inner = np.block(
        [
            [flat @ flat.T, common_line, common_trend.T, common_acting],
            [common_line.T, line, line_trend.T, line_acting],
            [common_trend, line_trend, trend_trend, trend_acting],
            [common_acting.T, line_acting.T, trend_acting.T, acting],
        ]
    )
    n = len(inner)
    inner[np.diag_indices(n)] += precision[:n]
    first = n - n_kinds * len(modes)
    inner[first : first + len(modes), first : first + len(modes)] += mean_precision
    diagonal = power + precision[n:]
    system = NormalEquations(
        inner, coupling, diagonal, _eliminate_slope_gains(inner, coupling, diagonal), np.zeros(0),
        common, sampling_derivative, actuator_derivatives, modes, model, residual, lines, trends, precision,
    )  # fmt: skip
    return system.update(residual, precision, offset)


def _common_products(
    common: NDArray[np.float64], actuator_derivatives: NDArray[np.float64], modes: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Products of the derivatives by common parameters and by effects ``(n_common, n_kinds * n_act)``."""
    k, n_slopes, n_modes = common.shape
    n_act = len(modes)
    total = np.zeros((n_act, k, len(actuator_derivatives)))
    for first in range(0, n_slopes, _SLOPES_AT_ONCE):
        part = slice(first, first + _SLOPES_AT_ONCE)
        onto_modes = (modes @ common[:, part].reshape(-1, n_modes).T).reshape(n_act, k, -1)
        total += onto_modes @ np.ascontiguousarray(actuator_derivatives[:, part].transpose(2, 1, 0))
    return total.transpose(1, 2, 0).reshape(k, -1)


def _eliminate_slope_gains(
    inner: NDArray[np.float64], coupling: NDArray[np.float64], diagonal: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Schur complement of the block of the slope gains."""
    scaled = coupling / np.sqrt(diagonal)[:, None]
    return np.asarray(inner - scaled.T @ scaled)
