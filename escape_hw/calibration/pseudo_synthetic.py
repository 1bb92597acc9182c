"""The pseudo-synthetic interaction matrix: the model's, at a measured registration (the paper)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import SyntheticModel
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import measured_matrix
from escape_hw.calibration.derivatives import modal_matrix
from escape_hw.calibration.found_mirror import found_jacobian


def pseudo_synthetic(
    model: SyntheticModel, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """The model's matrix at an estimated registration, and its standard errors.

    Parameters
    ----------
    model
        The synthetic model.
    estimate
        Result of SPRINT; what it found of single actuators is in the matrix.
    m2c
        Modal basis ``(n_act, n_modes)``.

    Returns
    -------
    matrix, sigma : ndarray, ``(n_slopes, n_modes)``
        The errors are those of registration, gain and the actuators' gains, propagated to first order.
    """
    gain = estimate.gain.value
    unit, derivatives, unequal = found_jacobian(model, estimate, m2c)
    jacobian = gain * derivatives[:5]
    variance = np.einsum("psm,pq,qsm->sm", jacobian, estimate.covariance, jacobian, optimize=True)
    variance += np.square(unit * estimate.gain.sigma) + gain**2 * unequal
    return gain * unit, np.sqrt(np.maximum(variance, 0))


def synthesise(
    bench: Bench, grid: SensorGeometry, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> CalibrationResult:
    """A calibration made of a registration alone, with nothing moved.

    Parameters
    ----------
    bench
        Gives the model.
    grid
        The sensor's grid.
    estimate
        The registration.
    m2c
        Modal basis ``(n_act, n_modes)``.
    """
    data, sigma = pseudo_synthetic(bench.model(grid), estimate, m2c)
    matrix = measured_matrix(bench, grid, m2c, data, sigma, "escape", gain=estimate.gain.value)
    return CalibrationResult(matrix, grid, 0, 0, 0.0, registration=estimate)


def synthetic_of(
    measured: CalibrationResult, model: SyntheticModel, estimate: RegistrationEstimate
) -> CalibrationResult:
    """The pseudo-synthetic matrix behind a measured one, with no bench at hand.

    Parameters
    ----------
    measured
        The calibration whose matrix was fitted.
    model
        The synthetic model on the geometry of that calibration.
    estimate
        The registration that fits it.
    """
    data, sigma = pseudo_synthetic(model, estimate, measured.matrix.m2c)
    matrix = replace(
        measured.matrix, data=data.astype(np.float32), sigma=sigma.astype(np.float32), method="escape",
        metrics={"gain": estimate.gain.value},
    )  # fmt: skip
    return replace(measured, matrix=matrix, measured=None, registration=estimate)


def at_rest(bench: Bench, calibration: CalibrationResult) -> InteractionMatrix | None:
    """A pyramid's pseudo-synthetic matrix for light that hardly moves, as a closed loop leaves it.

    Under the turbulence of the open loop, where its matrix was fitted, a pyramid's answer has another shape.
    Lenslets answer alike, and their model is the better for the motion, which averages over the pixels.
    Nothing moves.

    Parameters
    ----------
    bench
        Gives the model.
    calibration
        With the registration.

    Returns
    -------
    InteractionMatrix or None
        Of the same modes; ``None`` for a matrix that is not pseudo-synthetic, or not a pyramid's.
    """
    estimate, pupils = calibration.registration, calibration.grid
    if estimate is None or calibration.matrix.method != "escape" or not isinstance(pupils, PyramidPupils):
        return None
    return synthetic_of(calibration, bench.model(pupils.with_motion(0.0)), estimate).matrix


def simulated(bench: Bench, grid: SensorGeometry, m2c: NDArray[np.float64]) -> CalibrationResult:
    """What the model says of a mirror that stands where the design has it; nothing moves, nothing is fitted.

    Parameters
    ----------
    bench
        Gives the model.
    grid
        The sensor's grid.
    m2c
        Modal basis ``(n_act, n_modes)``.
    """
    data = modal_matrix(bench.model(grid), Registration(), m2c)
    matrix = measured_matrix(bench, grid, m2c, data, np.zeros_like(data), "simulated")
    return CalibrationResult(matrix, grid, 0, 0, 0.0)
