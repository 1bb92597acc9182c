"""The pseudo-synthetic interaction matrix: the synthetic model at an estimated registration.

It contains the fitted corrections of the actuators and has propagated standard errors.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import build_interaction_matrix
from escape_hw.calibration.modes.derivatives import modal_matrix, zonal_jacobian
from escape_hw.calibration.sprint.extra_parameters import build_fitted_extra_parameters
from escape_hw.calibration.sprint.influence_shape import InfluenceShape


@dataclass(frozen=True, slots=True, eq=False)
class FittedMatrix:
    """Matrix of the fitted mirror at unit gain.

    Parameters
    ----------
    unit
        The matrix ``(n_slopes, n_modes)``.
    derivatives
        By the five parameters of the registration and by the width ``(6, n_slopes, n_modes)``.
    variance
        Of the matrix, from the errors of the actuator gains ``(n_slopes, n_modes)``; 0 without corrections of
        the actuators.
    """

    unit: NDArray[np.float64]
    derivatives: NDArray[np.float64]
    variance: NDArray[np.float64]

    def with_errors(self, estimate: RegistrationEstimate) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix at the gain of an estimate, and its standard errors ``(n_slopes, n_modes)``.

        The errors are those of registration, gain and actuator gains, propagated to first order.
        """
        gain = estimate.gain.value
        jacobian = gain * self.derivatives[:5]
        variance = np.einsum("psm,pq,qsm->sm", jacobian, estimate.covariance, jacobian, optimize=True)
        variance += np.square(self.unit * estimate.gain.sigma) + gain**2 * self.variance
        return gain * self.unit, np.sqrt(np.maximum(variance, 0))


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
    if estimate.actuator_corrections is None and not estimate.extras:
        return modal_matrix(model, registration, m2c, estimate.width.value)
    return compute_fitted_jacobian(model, replace(estimate, registration=registration), m2c).unit


def compute_fitted_jacobian(
    model: SyntheticModel,
    estimate: RegistrationEstimate,
    m2c: NDArray[np.float64],
    shape: InfluenceShape | None = None,
) -> FittedMatrix:
    """Matrix of the fitted mirror, its derivatives, and its variance due to the actuators.

    Parameters
    ----------
    model, estimate, m2c
        As for :func:`compute_fitted_matrix`.
    shape
        The shape of the model's influence functions, of which terms at nearby registrations are used.
    """
    registration, width = estimate.registration, estimate.width.value
    corrections = estimate.actuator_corrections
    scaled_modes, variance, shape = m2c, 0.0, shape or InfluenceShape(model)
    coefficients = np.zeros(shape.n_terms)
    if corrections is None:
        single, jacobian = zonal_jacobian(model, registration, width)
    else:
        coefficients[: corrections.shape.size] = corrections.shape
        shaped = shape.linearise(registration, width, coefficients)
        jacobian, (along_x, along_y) = shaped.jacobian, corrections.position
        single = shaped.matrix + width * corrections.width * jacobian[5]
        single += along_x * jacobian[0] + along_y * jacobian[1]
        scaled_modes = (1 + corrections.gain)[:, None] * m2c
        variance = np.square(single) @ np.square(corrections.gain_sigma[:, None] * m2c)

    def profile_matrix(other: SyntheticModel, at: Registration) -> NDArray[np.float64]:
        return shape.profile_matrix(other, at, width, coefficients)

    for one in build_fitted_extra_parameters(model, estimate.extras):
        scaled_value = estimate.extras[one.name].value / one.prior_sigma
        single = single + scaled_value * one.matrix_change(profile_matrix, registration, scaled_value)
    unit = single @ scaled_modes
    return FittedMatrix(unit, jacobian @ scaled_modes, np.broadcast_to(variance, unit.shape))


def compute_pseudo_synthetic_matrix(
    model: SyntheticModel, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Pseudo-synthetic matrix and its standard errors for modes ``m2c (n_act, n_modes)``.

    Returns
    -------
    matrix, sigma : ndarray, ``(n_slopes, n_modes)``
        As of :meth:`FittedMatrix.with_errors`.
    """
    return compute_fitted_jacobian(model, estimate, m2c).with_errors(estimate)


def synthesise_calibration(
    bench: Bench,
    grid: SensorGeometry,
    estimate: RegistrationEstimate,
    m2c: NDArray[np.float64],
    fitted: FittedMatrix | None = None,
) -> CalibrationResult:
    """Calibration with the pseudo-synthetic matrix of an estimate for modes ``m2c``; moves no device.

    ``fitted``: the matrix of the fitted mirror, if it is known.
    """
    fitted = fitted or compute_fitted_jacobian(bench.model(grid), estimate, m2c)
    data, sigma = fitted.with_errors(estimate)
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
