"""Sensors that remove tip and tilt from their slopes.

Some control systems subtract the mean x and y slope from every frame. Their interaction matrices have columns
of zero mean, which a synthetic model reproduces when its columns are treated alike.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.modes.derivatives import (
    modal_jacobian,
    modal_matrix,
    zonal_components,
    zonal_jacobian,
    zonal_sum,
)
from escape_hw.calibration.sprint.forwarding import Forwarding

#: Mean slope of a column relative to its rms below which its tip and tilt count as removed: rounding in
#: single precision leaves 1e-6, a measured column about its noise over the root of the number of slopes.
_NEGLIGIBLE_MEAN = 1e-4
#: Share of the columns that may have a mean: those of a dead actuator may have been replaced.
_EXCEPTIONS = 0.05


def is_tip_tilt_removed(matrix: InteractionMatrix) -> bool:
    """Whether the mean x and y slopes of the columns vanish, with few exceptions."""
    axes = matrix.data.astype(float).reshape(2, -1, matrix.n_modes)
    rms = np.sqrt(np.square(axes).mean())
    means = np.abs(axes.mean(axis=1)).max(axis=0)
    return bool(np.mean(means >= _NEGLIGIBLE_MEAN * rms) <= _EXCEPTIONS)


def remove_tip_tilt(slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Slopes ``(..., n_slopes, n)``, all x then all y, without their means along each axis."""
    axes = slopes.reshape(*slopes.shape[:-2], 2, -1, slopes.shape[-1])
    return np.asarray((axes - axes.mean(axis=-2, keepdims=True)).reshape(slopes.shape))


class TipTiltFreeModel(Forwarding):
    """A differentiable synthetic model whose slopes have no mean.

    Parameters
    ----------
    original
        The model of a sensor that keeps them; its other members are passed on.
    """

    def __init__(self, original: SyntheticModel) -> None:
        super().__init__(original)

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)``."""
        return remove_tip_tilt(self.original.zonal_matrix(registration, width))

    def zonal_sum(
        self, functions: Sequence[tuple[NDArray[np.float64] | float, Registration, float]]
    ) -> NDArray[np.float64]:
        """Slopes of a sum of influence functions per unit command ``(n_slopes, n_act)``."""
        return remove_tip_tilt(zonal_sum(self.original, functions))

    def zonal_components(
        self, registration: Registration, width: float, functions: Sequence[tuple[float, float]]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slopes of influence functions of several widths, and derivatives of their sum."""
        matrices, derivatives = zonal_components(self.original, registration, width, functions)
        return remove_tip_tilt(matrices), remove_tip_tilt(derivatives)

    def zonal_jacobian(
        self, registration: Registration, width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Zonal matrix and its derivatives ``(6, n_slopes, n_act)``."""
        matrix, derivatives = zonal_jacobian(self.original, registration, width)
        return remove_tip_tilt(matrix), remove_tip_tilt(derivatives)

    def modal_matrix(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> NDArray[np.float64]:
        """Slopes per unit mode ``(n_slopes, n_modes)``."""
        return remove_tip_tilt(modal_matrix(self.original, registration, m2c, width))

    def modal_jacobian(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Modal matrix and its derivatives ``(6, n_slopes, n_modes)``."""
        matrix, derivatives = modal_jacobian(self.original, registration, m2c, width)
        return remove_tip_tilt(matrix), remove_tip_tilt(derivatives)

    def variants(self) -> Sequence[TipTiltFreeModel]:
        """The model's variants, treated alike."""
        return [TipTiltFreeModel(variant) for variant in self.original.variants()]

    def component_model(self) -> TipTiltFreeModel:
        """The model of one function of the profile, treated alike."""
        return TipTiltFreeModel(self.original.component_model())

    def passed_on(self, name: str) -> Any:
        """A member of the model; models that it makes are treated alike."""
        attribute = super().passed_on(name)
        if name not in ("with_pupil_shift", "around_pokes"):
            return attribute

        def treated_alike(*arguments: Any) -> TipTiltFreeModel | None:
            other = attribute(*arguments)
            return None if other is None else TipTiltFreeModel(other)

        return treated_alike
