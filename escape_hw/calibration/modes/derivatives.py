"""Interaction matrices of a synthetic model by mode or actuator, and their derivatives.

The derivatives with respect to the registration are the model's own where it has them, and central
differences otherwise.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import DifferentiableModel, SummingModel, SyntheticModel

#: Half steps of the central differences: registration in its units, relative width of the influence
#: functions.
_DIFFERENCE_STEPS = np.array([2.0, 2.0, 0.05, 0.2, 0.2, 0.02])


def modal_matrix(
    model: SyntheticModel, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
) -> NDArray[np.float64]:
    """Slopes per unit of each mode ``(n_slopes, n_modes)``.

    ``m2c``: mode-to-command matrix ``(n_act, n_modes)``; ``width``: scale of the influence functions' width
    relative to nominal.
    """
    if isinstance(model, DifferentiableModel):
        return model.modal_matrix(registration, m2c, width)
    return np.asarray(model.zonal_matrix(registration, width) @ m2c)


def modal_jacobian(
    model: SyntheticModel, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes per unit of each mode, and their derivatives.

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
    """Slopes per unit command ``(n_slopes, n_act)`` and their derivatives ``(6, n_slopes, n_act)``."""
    if isinstance(model, DifferentiableModel):
        return model.zonal_jacobian(registration, width)
    return _central_differences(model.zonal_matrix, registration, width)


def zonal_sum(
    model: SyntheticModel, functions: Sequence[tuple[NDArray[np.float64] | float, Registration, float]]
) -> NDArray[np.float64]:
    """Slopes of a sum of influence functions per unit command ``(n_slopes, n_act)``.

    Parameters
    ----------
    functions
        Factor, a number or ``(n_act,)``, registration and width of each.
    """
    if isinstance(model, SummingModel):
        return model.zonal_sum(functions)
    matrices = [np.multiply(factor, model.zonal_matrix(at, width)) for factor, at, width in functions]
    return np.asarray(sum(matrices[1:], start=matrices[0]))


def zonal_components(
    model: SyntheticModel, registration: Registration, width: float, functions: Sequence[tuple[float, float]]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Slopes of influence functions of several widths, and derivatives of their sum.

    Shapes and arguments are those of
    :meth:`~escape_hw.api.synthetic_model.SummingModel.zonal_components`.
    """
    if isinstance(model, SummingModel):
        return model.zonal_components(registration, width, functions)
    matrices, total = [], np.zeros(())
    for factor, relative_width in functions:
        matrix, derivatives = zonal_jacobian(model, registration, width * relative_width)
        derivatives[5] *= relative_width
        matrices.append(matrix)
        total = total + factor * derivatives
    return np.stack(matrices), np.asarray(total)


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
