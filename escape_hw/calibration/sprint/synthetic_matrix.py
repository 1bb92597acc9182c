"""The pseudo-synthetic interaction matrix: the synthetic model at an estimated registration.

It contains the fitted corrections of the actuators and has propagated standard errors.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.api.results import PROFILE_WIDTHS, CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import build_interaction_matrix
from escape_hw.calibration.modes.derivatives import component_jacobian, modal_jacobian, modal_matrix
from escape_hw.calibration.sprint.extra_parameters import build_fitted_extra_parameters


def compute_fitted_matrix(
    model: SyntheticModel,
    registration: Registration,
    estimate: RegistrationEstimate,
    m2c: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Matrix of the fitted mirror at unit gain ``(n_slopes, n_modes)``.

    The corrections belong to the actuators, so any modal basis can be used.

    Parameters
    ----------
    model, registration
        The synthetic model, and the registration at which to compute the matrix.
    estimate
        Result of SPRINT, of which extra parameters, actuator corrections and width are used; without
        corrections the mirror is the nominal one at the estimated width.
    m2c
        Modes ``(n_act, n_modes)``.
    """
    scaled_modes = _apply_actuator_gains(estimate, m2c)
    nominal = modal_matrix(model, registration, scaled_modes, estimate.width.value)
    return _add_corrections(nominal, model, registration, estimate, scaled_modes)


def compute_fitted_jacobian(
    model: SyntheticModel, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Matrix of the fitted mirror, its derivatives, and its variance due to the actuators.

    Parameters
    ----------
    model, estimate, m2c
        As for :func:`compute_fitted_matrix`.

    Returns
    -------
    matrix : ndarray, ``(n_slopes, n_modes)``
    derivatives : ndarray, ``(6, n_slopes, n_modes)``
        By the five parameters of the registration and by the width.
    variance : ndarray, ``(n_slopes, n_modes)``
        Of the matrix, from the errors of the actuator gains; 0 without actuator corrections.
    """
    registration, width = estimate.registration, estimate.width.value
    corrections = estimate.actuator_corrections
    scaled_modes = _apply_actuator_gains(estimate, m2c)
    unit, derivatives = modal_jacobian(model, registration, scaled_modes, width)
    actuator_variance = np.zeros_like(unit)
    if corrections is not None:
        base, nominal = derivatives, model.zonal_matrix(registration, width)
        single = nominal
        for relative_width, share in zip(PROFILE_WIDTHS, corrections.profile, strict=True):
            component = component_jacobian(model, registration, width, relative_width, scaled_modes)[1]
            derivatives = derivatives + share * (component - base)
            single = single + share * (model.zonal_matrix(registration, width * relative_width) - nominal)
        actuator_variance = np.square(single) @ np.square(corrections.gain_sigma[:, None] * m2c)
    return _add_corrections(unit, model, registration, estimate, scaled_modes), derivatives, actuator_variance


def _apply_actuator_gains(estimate: RegistrationEstimate, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modes with the fitted gains of the actuators ``(n_act, n_modes)``."""
    corrections = estimate.actuator_corrections
    return m2c if corrections is None else (1 + corrections.gain)[:, None] * m2c


def _add_corrections(
    unit: NDArray[np.float64],
    model: SyntheticModel,
    registration: Registration,
    estimate: RegistrationEstimate,
    scaled_modes: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Add extra parameters, and to first order the widths of the actuators and the pedestal."""
    corrections, width = estimate.actuator_corrections, estimate.width.value
    for one in build_fitted_extra_parameters(model, estimate.extras):
        scaled_value = estimate.extras[one.name].value / one.prior_sigma
        unit = unit + scaled_value * (one.matrix_change(registration, width, scaled_value) @ scaled_modes)
    if corrections is None:
        return unit
    wider = corrections.width[:, None] * scaled_modes
    nominal = modal_matrix(model, registration, scaled_modes, width)
    own = modal_jacobian(model, registration, wider, width)[1][5]
    change = width * own
    for relative_width, share in zip(PROFILE_WIDTHS, corrections.profile, strict=True):
        component = modal_matrix(model, registration, scaled_modes, width * relative_width)
        by_width = component_jacobian(model, registration, width, relative_width, wider)[1][5]
        change = change + share * (component - nominal + width * (by_width - own))
    return np.asarray(unit + change)


def compute_pseudo_synthetic_matrix(
    model: SyntheticModel, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pseudo-synthetic matrix and its standard errors for modes ``m2c (n_act, n_modes)``.

    Returns
    -------
    matrix, sigma : ndarray, ``(n_slopes, n_modes)``
        The errors are those of registration, gain and actuator gains, propagated to first order.
    """
    gain = estimate.gain.value
    unit, derivatives, actuator_variance = compute_fitted_jacobian(model, estimate, m2c)
    jacobian = gain * derivatives[:5]
    variance = np.einsum("psm,pq,qsm->sm", jacobian, estimate.covariance, jacobian, optimize=True)
    variance += np.square(unit * estimate.gain.sigma) + gain**2 * actuator_variance
    return gain * unit, np.sqrt(np.maximum(variance, 0))


def synthesise_calibration(
    bench: Bench, grid: SensorGeometry, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> CalibrationResult:
    """Calibration with the pseudo-synthetic matrix of an estimate for modes ``m2c``; moves no device."""
    data, sigma = compute_pseudo_synthetic_matrix(bench.model(grid), estimate, m2c)
    matrix = build_interaction_matrix(bench, grid, m2c, data, sigma, "escape", gain=estimate.gain.value)
    return CalibrationResult(matrix, grid, 0, 0, 0.0, registration=estimate)


def synthesise_from_measurement(
    measured: CalibrationResult, model: SyntheticModel, estimate: RegistrationEstimate
) -> CalibrationResult:
    """The same for a measured calibration and a model on its geometry, without a bench."""
    data, sigma = compute_pseudo_synthetic_matrix(model, estimate, measured.matrix.m2c)
    matrix = replace(
        measured.matrix, data=data.astype(np.float32), sigma=sigma.astype(np.float32), method="escape",
        metrics={"gain": estimate.gain.value},
    )  # fmt: skip
    return replace(measured, matrix=matrix, measured=None, registration=estimate)


def static_light_matrix(bench: Bench, calibration: CalibrationResult) -> InteractionMatrix | None:
    """Pseudo-synthetic matrix of a pyramid for light that hardly moves, as in closed loop.

    The response of a pyramid under the turbulence of the open loop, where its matrix was fitted, has another
    shape. For lenslets the response does not depend on the motion, and their model is better with it, because
    it averages over the pixels. Moves no device.

    Returns
    -------
    InteractionMatrix or None
        Of the same modes; ``None`` if the matrix is not pseudo-synthetic, or not of a pyramid.
    """
    estimate, pupils = calibration.registration, calibration.grid
    if estimate is None or calibration.matrix.method != "escape" or not isinstance(pupils, PyramidPupils):
        return None
    return synthesise_from_measurement(
        calibration, bench.model(pupils.with_slope_statistics(0.0)), estimate
    ).matrix


def nominal_calibration(bench: Bench, grid: SensorGeometry, m2c: NDArray[np.float64]) -> CalibrationResult:
    """Calibration with the synthetic matrix at the nominal registration; moves no device."""
    data = modal_matrix(bench.model(grid), Registration(), m2c)
    matrix = build_interaction_matrix(bench, grid, m2c, data, np.zeros_like(data), "simulated")
    return CalibrationResult(matrix, grid, 0, 0, 0.0)
