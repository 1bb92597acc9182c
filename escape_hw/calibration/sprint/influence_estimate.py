"""Influence functions that SPRINT has found, as surfaces: profile with errors, and maps of all actuators.

The terms of the common shape are sums of nominal influence functions. A model that gives heights instead
of slopes (:class:`~escape_hw.api.synthetic_model.HasSurfaces`) turns fitted coefficients into surfaces.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.influence import InfluenceEstimate, InfluenceProfile
from escape_hw.api.registration import Registration
from escape_hw.api.results import ActuatorCorrections, RegistrationEstimate
from escape_hw.api.synthetic_model import HasActuatorPositions, HasSurfaces, SyntheticModel
from escape_hw.calibration.sprint.influence_shape import InfluenceShape, find_edge_actuators
from escape_hw.errors import CalibrationError

#: Radii of a profile in pitches.
_RADII = np.arange(0.0, 4.01, 0.1)
#: Points per pitch of the maps, and their margin around the actuators in pitches.
_POINTS_PER_PITCH, _MARGIN = 8, 2.5
#: Heights that are computed at once.
_BLOCK_VALUES = 1e6


def estimate_profile(
    model: SyntheticModel, width: float, coefficients: NDArray[np.float64], covariance: NDArray[np.float64]
) -> InfluenceProfile | None:
    """Profile of a fitted common shape; ``None`` for a model without surfaces or positions.

    Parameters
    ----------
    model
        The synthetic model of the fit.
    width, coefficients
        Common width relative to nominal, and coefficients of the shape ``(n_terms,)``.
    covariance
        Their covariance ``(1 + n_terms, 1 + n_terms)``.
    """
    if not isinstance(model, HasSurfaces) or not isinstance(model, HasActuatorPositions):
        return None
    positions = np.asarray(model.actuator_positions_m)
    pitch, edge = actuator_pitch(positions), find_edge_actuators(positions)
    inner = int(np.argmin(np.linalg.norm(positions - positions.mean(axis=0), axis=1)))
    nominal, fitted, sigma = _cut(model, inner, (0, 1), pitch, width, coefficients, covariance)
    of_edge = np.zeros((2, 0))
    if edge.any():
        # The actuator nearest to +x, along the edge, where its asymmetry outwards has no effect.
        away = np.where(edge, np.abs(positions[:, 1]) - positions[:, 0], np.inf)
        _, *values = _cut(model, int(np.argmin(away)), (1,), pitch, width, coefficients, covariance)
        of_edge = np.array(values)
    return InfluenceProfile(_RADII, nominal, fitted, sigma, *of_edge)


def _cut(
    model: HasSurfaces,
    actuator: int,
    axes: tuple[int, ...],
    pitch_m: float,
    width: float,
    coefficients: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Nominal and fitted heights of an actuator, and errors of these, mean of both directions of the axes."""
    centre = np.asarray(model.actuator_positions_m)[actuator]  # type: ignore[attr-defined]
    parts = []
    for axis in axes:
        along = [centre[axis : axis + 1], centre[1 - axis : 2 - axis]]
        along[0] = centre[axis] + pitch_m * np.concatenate([_RADII, -_RADII])
        surfaces = model.surface_model(*(along if axis == 0 else along[::-1]))
        shape = InfluenceShape(surfaces)
        # The mean over all directions has no four-fold term.
        radial = np.array([not name.startswith("fourfold") for name in shape.names])
        shaped = shape.linearise(Registration(), width, coefficients * radial)
        derivatives = np.stack([part[:, actuator] for part in (shaped.jacobian[5], *shaped.terms)])
        derivatives[1:] *= radial[:, None]
        nominal = surfaces.zonal_matrix(Registration())[:, actuator]
        parts.append(np.stack([nominal, shaped.matrix[:, actuator], *derivatives]))
    heights = np.mean([part.reshape(len(part), 2, -1).mean(axis=1) for part in parts], axis=0)
    variance = np.einsum("pr,pq,qr->r", heights[2:], covariance, heights[2:])
    return heights[0], heights[1], np.sqrt(np.maximum(variance, 0.0))


def estimate_influence_functions(model: SyntheticModel, estimate: RegistrationEstimate) -> InfluenceEstimate:
    """Influence functions of all actuators that SPRINT has found, on a grid.

    Parameters
    ----------
    model
        The synthetic model of the fit.
    estimate
        Result of SPRINT with corrections of the actuators.

    Raises
    ------
    CalibrationError
        The fit did not converge, the estimate has no fitted actuators, or the model no surfaces.
    """
    if not estimate.converged:
        raise CalibrationError(
            f"the fit of the registration did not converge: {'; '.join(estimate.warnings)}; its influence "
            "functions are not to be used"
        )
    corrections, profile = estimate.actuator_corrections, estimate.influence_profile
    if corrections is None or corrections.shape_covariance is None:
        raise CalibrationError(
            "the registration has no fitted influence functions with errors; run SPRINT (escape sprint) with "
            "calibration.solver = 'mixed-effects' and calibration.actuator_model = 'fitted'"
        )
    if profile is None or not isinstance(model, HasSurfaces) or not isinstance(model, HasActuatorPositions):
        raise CalibrationError(f"the model '{model.name}' has no surfaces; use calibration.model = 'fast'")
    nominal = np.asarray(model.actuator_positions_m)
    pitch, percent = actuator_pitch(nominal), model.sub_aperture_m / 100
    step = pitch / _POINTS_PER_PITCH
    low, high = nominal.min(axis=0), nominal.max(axis=0)
    half = np.ceil((np.maximum(-low, high) + _MARGIN * pitch) / step)
    x, y = (np.arange(-n, n + 1) * step for n in half)
    rows = max(1, int(_BLOCK_VALUES / (x.size * len(nominal))))
    blocks = [
        _surfaces(model.surface_model(x, y[first : first + rows]), estimate.width.value, corrections)
        for first in range(0, y.size, rows)
    ]
    heights, variance = (
        np.concatenate(parts).T.reshape(len(nominal), y.size, x.size) for parts in zip(*blocks, strict=True)
    )
    return InfluenceEstimate(
        heights, np.sqrt(np.maximum(variance, 0.0)), x, y, pitch,
        nominal + percent * corrections.position.T, percent * corrections.position_sigma.T,
        corrections.gain, corrections.gain_sigma, find_edge_actuators(nominal), profile,
        estimate.sigma * [percent, percent, 1.0, 1.0, 1.0], estimate.model_fits,
    )  # fmt: skip


def _surfaces(
    surface_model: SyntheticModel, width: float, corrections: ActuatorCorrections
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Heights ``(n_points, n_act)`` of the fitted mirror, and their variances."""
    shape = InfluenceShape(surface_model)
    shaped = shape.linearise(Registration(), width, corrections.shape)
    by_width, (along_x, along_y) = width * shaped.jacobian[5], corrections.position
    unit = shaped.matrix + corrections.width * by_width
    unit += along_x * shaped.jacobian[0] + along_y * shaped.jacobian[1]
    common = np.stack([shaped.jacobian[5], *shaped.terms])
    covariance = np.asarray(corrections.shape_covariance)
    variance = np.einsum("psa,pq,qsa->sa", common, covariance, common, optimize=True)
    variance += np.square(by_width * corrections.width_sigma)
    for axis in (0, 1):
        variance += np.square(shaped.jacobian[axis] * corrections.position_sigma[axis])
    gain = 1 + corrections.gain
    return unit * gain, variance * gain**2 + np.square(unit * corrections.gain_sigma)


def actuator_pitch(positions_m: NDArray[np.float64]) -> float:
    """Median distance of an actuator to its nearest neighbour, from positions ``(n_act, 2)``."""
    distance = np.linalg.norm(positions_m[:, None] - positions_m, axis=2)
    return float(np.median(np.sort(distance, axis=1)[:, 1]))
