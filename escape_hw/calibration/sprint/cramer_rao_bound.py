"""Hybrid Cramer-Rao bound of the registration for the frames of a DO-CRIME run.

``docs/theory/sky-time.md`` derives it. Gain and registration are fixed unknowns; the differences between a
real mirror and sensor and the model are random effects of known scatter, and the bound that includes both is
the *hybrid* one (Rockah & Schultheiss 1987).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_matrix
from escape_hw.calibration.sprint.covariance import LowRankNoise
from escape_hw.calibration.sprint.mixed_effects import MixedEffectsProblem
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix


@dataclass(frozen=True, slots=True, eq=False)
class CramerRaoBound:
    """Smallest possible standard errors of the registration ``(5,)``.

    Parameters
    ----------
    exact
        For an exact model: gain and registration are the only unknowns.
    hybrid
        With the random effects as further unknowns of known scatter.
    """

    exact: NDArray[np.float64]
    hybrid: NDArray[np.float64]


def compute_registration_bound(
    matrix: InteractionMatrix,
    gram: NDArray[np.float64],
    covariance: NDArray[np.float64],
    model: SyntheticModel,
    registration: Registration,
    priors: Priors,
) -> CramerRaoBound:
    """Compute the bound for the pokes of a run.

    Parameters
    ----------
    matrix
        A matrix of this sensor and basis; its data determine the gain.
    gram
        Sum over the frames of products of whitened pokes ``(n_modes, n_modes)``, of any rank.
    covariance
        Covariance of one frame's whitened noise ``(n_slopes, n_slopes)``, or only its diagonal
        ``(n_slopes,)``.
    model, registration, priors
        Synthetic model on the same sub-apertures, registration of the bound, scatter of the random effects.
    """
    variance = np.diag(covariance) if covariance.ndim == 2 else covariance
    unit = modal_matrix(model, registration, matrix.m2c)
    gain = float(np.vdot(unit, matrix.data) / np.vdot(unit, unit))
    truth = replace(matrix, data=(gain * unit).astype(np.float32))
    columns = decorrelate_columns(truth, gram, variance)
    if covariance.ndim == 2:
        # The correlation of the noise is included explicitly.
        priors = replace(priors, noise_inflation=1.0)
    problem = MixedEffectsProblem(
        WeightedMatrix.from_columns(columns, np.arange(columns.n_modes)), model, priors
    )
    system = problem.linearise(problem.initial_state(registration))
    if covariance.ndim == 2:
        noise = LowRankNoise.from_covariance(
            covariance, problem.weighted.weigh(model.zonal_matrix(registration))
        )
        information_matrix = correlated_information(system, problem.precision, noise.inverse())
        hybrid = np.linalg.inv(information_matrix)
    else:
        information_matrix, hybrid = system.inner, np.linalg.inv(system.information())
    exact = np.linalg.inv(information_matrix[:6, :6])
    return CramerRaoBound(np.sqrt(np.diag(exact)[1:6]), np.sqrt(np.diag(hybrid)[1:6]))


def correlated_information(
    system: NormalEquations, precision: NDArray[np.float64], metric: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Information on all unknowns for correlated noise of the slopes.

    As :func:`~.normal_equations.normal_equations` with ``J^T R^-1 J`` in place of ``J^T J``; the derivatives
    by actuators and slopes are outer products here as well and are not formed.

    Parameters
    ----------
    system
        The linearised problem, weighted by the standard errors of the slopes.
    precision
        Prior precision of every unknown ``(n,)``.
    metric
        Inverse of the correlation matrix of the noise of the slopes ``(n_slopes, n_slopes)``.
    """
    common, sampling_derivative = system.common, system.sampling_derivative
    model, modes, k = system.model, system.modes, len(system.common)
    member = (system.lines[:, None] == np.arange(system.lines.max() + 1)).astype(float)
    zonal = np.concatenate(system.actuator_derivatives, axis=1)
    n_kinds = len(system.actuator_derivatives)
    repeated_modes = np.tile(modes, (n_kinds, 1))
    metric_common = np.einsum("st,ptm->psm", metric, common, optimize=True)
    metric_zonal = metric @ zonal
    flat = common.reshape(k, -1)
    common_acting = (np.concatenate([metric_common @ modes.T] * n_kinds, axis=2) * zonal).sum(axis=1)
    by_line, by_slope = (
        np.einsum("psm,sm->ps", metric_common, part, optimize=True) for part in (sampling_derivative, model)
    )
    line_acting, slope_acting = (
        (part @ repeated_modes.T) * metric_zonal for part in (sampling_derivative, model)
    )
    line_line = member.T @ (metric * (sampling_derivative @ sampling_derivative.T)) @ member
    slope_line = (metric * (model @ sampling_derivative.T)) @ member
    acting = (zonal.T @ metric_zonal) * (repeated_modes @ repeated_modes.T)
    slope_slope = metric * (model @ model.T)
    # A trend is a linear combination of slope gains.
    trends, line_trend = system.trends, slope_line.T @ system.trends
    common_trend, slope_trend = by_slope @ trends, slope_slope @ trends
    trend_acting = trends.T @ slope_acting
    information_matrix = np.block(
        [
            [metric_common.reshape(k, -1) @ flat.T, by_line @ member, common_trend, common_acting, by_slope],
            [(by_line @ member).T, line_line, line_trend, member.T @ line_acting, slope_line.T],
            [common_trend.T, line_trend.T, trends.T @ slope_trend, trend_acting, slope_trend.T],
            [common_acting.T, (member.T @ line_acting).T, trend_acting.T, acting, slope_acting.T],
            [by_slope.T, slope_line, slope_trend, slope_acting, slope_slope],
        ]
    )
    information_matrix[np.diag_indices(len(information_matrix))] += precision
    return np.asarray(information_matrix)
