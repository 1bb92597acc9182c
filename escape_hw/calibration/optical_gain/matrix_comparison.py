"""Optical gain of every mode from two interaction matrices, and scaling of a matrix by gains."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.errors import CalibrationError

ValuesAndErrors = tuple[NDArray[np.float64], NDArray[np.float64]]


def deviation_ratio(measured: InteractionMatrix, reference: InteractionMatrix) -> ValuesAndErrors:
    """Optical gains by the paper's estimator, ``OG_i = stdev(D_i) / stdev(Dhat_i)`` over the slopes.

    Noise increases a standard deviation, so the gain of a noisy column is biased to large values:
    ``E[stdev^2] = stdev_0^2 + mean(sigma^2)``. :func:`projection` has no such bias.

    ``measured``: matrix for the wavefront at which the gains are wanted (the paper's D); ``reference``:
    matrix for another wavefront.

    Returns
    -------
    value, sigma : ndarray, ``(n_modes,)``
        The standard errors assume independent elements and do not include the bias.

    Raises
    ------
    CalibrationError
        The matrices have different slopes or modes, or a mode of the reference is empty.
    """
    _require_same_basis(measured, reference)
    measured_deviation, measured_variance = _deviation(measured)
    reference_deviation, reference_variance = _deviation(reference)
    if not (reference_deviation > 0).all():
        raise CalibrationError(f"mode {int(np.argmin(reference_deviation))} of the reference matrix is empty")
    value = measured_deviation / reference_deviation
    with np.errstate(divide="ignore", invalid="ignore"):
        relative = np.where(measured_deviation > 0, measured_variance / measured_deviation**2, np.inf)
        relative = relative + reference_variance / reference_deviation**2
    return value, value * np.sqrt(relative)


def _deviation(matrix: InteractionMatrix) -> ValuesAndErrors:
    """Standard deviation of every column over the slopes, and the variance of that estimate."""
    data, noise = matrix.data.astype(np.float64), np.square(matrix.sigma, dtype=np.float64)
    centred = data - data.mean(axis=0)
    variance = np.mean(np.square(centred), axis=0)
    n = data.shape[0]
    # Variance of a mean of squares of normal variables with these means and variances; the column contains
    # the noise, hence the difference.
    spread = (4 * np.sum(centred**2 * noise, axis=0) - 2 * np.sum(noise**2, axis=0)) / n**2
    with np.errstate(divide="ignore", invalid="ignore"):
        return np.sqrt(variance), np.where(variance > 0, np.maximum(spread, 0) / (4 * variance), 0.0)


def slope_weights(matrix: InteractionMatrix) -> NDArray[np.float64]:
    """Weight of every slope ``(n_slopes,)``, of mean 1: the inverse of its mean noise variance.

    The weights are common to all modes, because the noise of a slope does not depend on the poked mode.
    Without standard errors they are equal.
    """
    variance = np.mean(np.square(matrix.sigma, dtype=np.float64), axis=1)
    if not (np.isfinite(variance).all() and (variance > 0).all()):
        return np.ones(variance.size)
    weights = 1 / variance
    return np.asarray(weights / weights.mean())


def projector(reference: InteractionMatrix, weights: NDArray[np.float64]) -> NDArray[np.float64]:
    """Matrix ``P`` that maps slopes to gains: ``P D`` has the optical gains of ``D`` on its diagonal.

    ``P_m = r_m^T W / (r_m^T W r_m - sum(w sigma_m^2))``, with ``r_m`` the columns of the reference. The
    second term corrects the bias due to the noise of the reference.

    ``reference``: matrix relative to which the gains are defined; ``weights``: weights of the slopes
    ``(n_slopes,)``, independent of the values of the data.

    Returns ``(n_modes, n_slopes)``.

    Raises
    ------
    CalibrationError
        A mode of the reference is dominated by noise.
    """
    columns = reference.data.astype(np.float64)
    noise = np.nan_to_num(np.square(reference.sigma, dtype=np.float64), posinf=0.0)
    power = weights @ np.square(columns)
    signal = power - weights @ noise
    if not (signal > 0.1 * power).all():
        raise CalibrationError(
            f"mode {int(np.argmin(signal / np.maximum(power, 1e-300)))} of the reference matrix is noise; "
            "measure it with more frames, or use a pseudo-synthetic one"
        )
    return np.asarray((columns * weights[:, None] / signal).T)


def projection(measured: InteractionMatrix, reference: InteractionMatrix) -> ValuesAndErrors:
    """Optical gains by weighted regression of a matrix on a reference, without bias from noise.

    ``g_m = r_m^T W d_m / (r_m^T W r_m - sum(w sigma^2))`` with weights from the standard errors.

    Returns
    -------
    value, sigma : ndarray, ``(n_modes,)``
        The standard errors assume independent elements; for correlated slopes use
        :class:`~escape_hw.calibration.optical_gain.estimator.OpticalGainEstimator`.

    Raises
    ------
    CalibrationError
        As for :func:`deviation_ratio`, or a mode of the reference is dominated by noise.
    """
    _require_same_basis(measured, reference)
    weights = slope_weights(measured)
    rows = projector(reference, weights)
    value = np.einsum("ms,sm->m", rows, measured.data)
    noise = np.square(measured.sigma, dtype=np.float64)
    scaled = np.nan_to_num(np.square(reference.sigma, dtype=np.float64), posinf=0.0)
    # d(g) = P_m (dd - g dr) to first order in the noise of either column.
    variance = np.einsum("ms,sm->m", rows**2, noise + value**2 * scaled)
    return value, np.sqrt(variance)


def scale_matrix(
    matrix: InteractionMatrix, gains: NDArray[np.float64], sigma: NDArray[np.float64] | None = None
) -> InteractionMatrix:
    """The matrix for the wavefront at which the gains were measured (paper: ``OG . D``).

    ``matrix``: ``(n_slopes, n_modes)``; ``gains``, ``sigma``: gain of every mode and its standard error
    ``(n_modes,)``, which is added to those of the elements.

    Raises
    ------
    ValueError
        The gains are not positive and finite, or not one per mode.
    """
    if gains.shape != (matrix.n_modes,) or not (np.isfinite(gains).all() and (gains > 0).all()):
        raise ValueError(f"{matrix.n_modes} positive optical gains are needed, not {gains}")
    error = np.zeros_like(gains) if sigma is None else sigma
    variance = np.square(matrix.sigma * gains) + np.square(matrix.data * error)
    metrics = {**matrix.metrics, "optical_gain": float(np.mean(gains))}
    scaled, scaled_sigma = (matrix.data * gains).astype(np.float32), np.sqrt(variance).astype(np.float32)
    return replace(matrix, data=scaled, sigma=scaled_sigma, metrics=metrics)


def _require_same_basis(measured: InteractionMatrix, reference: InteractionMatrix) -> None:
    """Raise :class:`CalibrationError` unless both have the same slopes and modes."""
    if measured.data.shape != reference.data.shape or not np.array_equal(measured.valid, reference.valid):
        raise CalibrationError(
            f"matrices of {measured.data.shape} and {reference.data.shape} slopes and modes, or with other "
            "valid sub-apertures, have no optical gain; measure both on the same geometry"
        )
    if not np.allclose(measured.m2c, reference.m2c):
        raise CalibrationError("the matrices are of different modes; measure both in the same basis")
