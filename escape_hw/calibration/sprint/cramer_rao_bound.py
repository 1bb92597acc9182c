"""The least error of a registration that frames of a DO-CRIME run allow: the Cramer-Rao bound.

``docs/theory/sky-time.md`` derives it. Gain and registration are fixed unknowns; what a real mirror and
sensor have besides are random effects with a known scatter, and the bound that counts both kinds is the
*hybrid* one (Rockah & Schultheiss 1987).
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_matrix
from escape_hw.calibration.sprint.covariance import MODEL_ERROR_FLOOR, LowRankNoise
from escape_hw.calibration.sprint.mixed_effects import MixedEffectsProblem
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix


@dataclass(frozen=True, slots=True, eq=False)
class CramerRaoBound:
    """Least standard errors of the registration ``(5,)``.

    Parameters
    ----------
    exact
        For a model that is exact: gain and registration are the only unknowns.
    hybrid
        With the random effects, and with what the model still misses.
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
    """The bound for pokes that were really sent.

    Parameters
    ----------
    matrix
        A matrix of this sensor and basis; its data tell the gain.
    gram
        Sum over the frames of whitened pokes times whitened pokes ``(n_modes, n_modes)``: of any rank.
    covariance
        Covariance of one frame's whitened noise ``(n_slopes, n_slopes)``, or its diagonal ``(n_slopes,)``
        where more is not known.
    model
        The synthetic model on the same grid.
    registration
        Where to take the bound.
    priors
        Scatter of the random effects.
    """
    variance = np.diag(covariance) if covariance.ndim == 2 else covariance
    unit = modal_matrix(model, registration, matrix.m2c)
    gain = float(np.vdot(unit, matrix.data) / np.vdot(unit, unit))
    truth = replace(matrix, data=(gain * unit).astype(np.float32))
    columns = decorrelate_columns(truth, gram, variance)
    if covariance.ndim == 2:
        # What the slopes' noise has in common is counted as such.
        priors = replace(priors, noise_inflation=1.0)
    problem = MixedEffectsProblem(WeightedMatrix.of(columns, np.arange(columns.n_modes)), model, priors)
    system = problem.linearise(problem.start(registration))
    if covariance.ndim == 2:
        noise = LowRankNoise.of(covariance, problem.weighted.weigh(model.zonal_matrix(registration)))
        information_matrix = correlated_information(system, problem.precision, noise.inverse())
        hybrid = np.linalg.inv(information_matrix)
    else:
        information_matrix, hybrid = system.inner, np.linalg.inv(system.information())
    exact = np.linalg.inv(information_matrix[:6, :6])
    return CramerRaoBound(
        np.sqrt(np.diag(exact)[1:6]), np.sqrt(np.diag(hybrid)[1:6] + np.square(MODEL_ERROR_FLOOR))
    )


def correlated_information(
    system: NormalEquations, precision: NDArray[np.float64], inverse: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Information on all unknowns where neighbouring slopes err together.

    As :func:`~.misfit.normal_equations` with ``J^T R^-1 J`` in place of ``J^T J``; the derivatives by
    actuators and slopes are outer products here as well, and are never written out.

    Parameters
    ----------
    system
        The linearised problem, weighted by the slopes' standard errors.
    precision
        Prior precision of every unknown.
    inverse
        Inverse of the correlation matrix of the slopes' noise ``(n_slopes, n_slopes)``.

    Returns
    -------
    ndarray, ``(n, n)``
        In the order of the unknowns.
    """
    common, sampling_derivative, model, modes = (
        system.common,
        system.sampling_derivative,
        system.model,
        system.modes,
    )
    metric, k = inverse, len(common)
    member = (system.lines[:, None] == np.arange(system.lines.max() + 1)).astype(float)
    zonal = np.concatenate([system.gain_derivative, system.width_derivative], axis=1)
    modes_twice = np.concatenate([modes, modes])
    metric_common = np.einsum("st,ptm->psm", metric, common, optimize=True)
    metric_zonal = metric @ zonal
    flat = common.reshape(k, -1)
    common_acting = (np.concatenate([metric_common @ modes.T] * 2, axis=2) * zonal).sum(axis=1)
    by_line, by_slope = (
        np.einsum("psm,sm->ps", metric_common, part, optimize=True) for part in (sampling_derivative, model)
    )
    line_acting, slope_acting = (
        (part @ modes_twice.T) * metric_zonal for part in (sampling_derivative, model)
    )
    line_line = member.T @ (metric * (sampling_derivative @ sampling_derivative.T)) @ member
    slope_line = (metric * (model @ sampling_derivative.T)) @ member
    acting = (zonal.T @ metric_zonal) * (modes_twice @ modes_twice.T)
    slope_slope = metric * (model @ model.T)
    # A trend is a sum of slope gains.
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
