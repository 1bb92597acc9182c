"""Interaction matrices of a synthetic model by mode or actuator, and their derivatives.

The derivatives with respect to the registration are the model's own where it has them, and central
differences otherwise.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import DifferentiableModel, SyntheticModel

#: Half steps of the central differences: registration in its units, relative width of the influence
#: functions.
_DIFFERENCE_STEPS = np.array([2.0, 2.0, 0.05, 0.2, 0.2, 0.02])


def modal_matrix(
    model: SyntheticModel, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
) -> NDArray[np.float64]:
    """Slopes per unit of each mode ``(n_slopes, n_modes)``.

    Parameters
    ----------
    model
        Any synthetic model.
    registration
        Registration of the mirror.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    width
        Scale of the influence functions' width relative to nominal.
    """
    if isinstance(model, DifferentiableModel):
        return model.modal_matrix(registration, m2c, width)
    return np.asarray(model.zonal_matrix(registration, width) @ m2c)


def modal_jacobian(
    model: SyntheticModel, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes per unit of each mode, and their derivatives.

    Parameters
    ----------
    model, registration, m2c, width
        As for :func:`modal_matrix`.

    Returns
    -------
    matrix : ndarray, ``(n_slopes, n_modes)``
    derivatives : ndarray, ``(6, n_slopes, n_modes)``
        By the five parameters of the registration, in their units, and by the width.
    """
    if isinstance(model, DifferentiableModel):
        return model.modal_jacobian(registration, m2c, width)
    return _central_differences(lambda r, w: np.asarray(model.zonal_matrix(r, w) @ m2c), registration, width)


def zonal_jacobian(
    model: SyntheticModel, registration: Registration, width: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes per unit command ``(n_slopes, n_act)`` and their derivatives ``(6, n_slopes, n_act)``.

    Parameters
    ----------
    model, registration, width
        As for :func:`modal_matrix`.
    """
    if isinstance(model, DifferentiableModel):
        return model.zonal_jacobian(registration, width)
    return _central_differences(model.zonal_matrix, registration, width)


def component_jacobian(
    model: SyntheticModel,
    registration: Registration,
    width: float,
    relative_width: float,
    m2c: NDArray[np.float64] | None = None,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes of a component of the influence functions' radial profile, and their derivatives.

    Parameters
    ----------
    model, registration
        As for :func:`modal_matrix`.
    width, relative_width
        Scale of the influence functions' width, and the width of the component relative to it.
    m2c
        Modes ``(n_act, n_modes)``; single actuators by default.

    Returns
    -------
    matrix : ndarray, ``(n_slopes, n_modes)``
    derivatives : ndarray, ``(6, n_slopes, n_modes)``
        By the five parameters of the registration, in their units, and by ``width``.
    """
    if m2c is None:
        matrix, derivatives = zonal_jacobian(model, registration, relative_width * width)
    else:
        matrix, derivatives = modal_jacobian(model, registration, m2c, relative_width * width)
    return matrix, np.concatenate([derivatives[:5], relative_width * derivatives[5:]])


def _central_differences(
    build_matrix: Callable[[Registration, float], NDArray[np.float64]],
    registration: Registration,
    width: float,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    centre = np.append(registration.to_array(), width)
    steps = _DIFFERENCE_STEPS * np.append(np.ones(5), width)

    def evaluate(point: NDArray[np.float64]) -> NDArray[np.float64]:
        return build_matrix(Registration.from_array(point[:5]), float(point[5]))

    derivatives = [
        (evaluate(centre + step) - evaluate(centre - step)) / (2 * step.sum()) for step in np.diag(steps)
    ]
    return build_matrix(registration, width), np.stack(derivatives)
