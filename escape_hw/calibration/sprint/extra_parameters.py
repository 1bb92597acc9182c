"""Extra parameters that SPRINT can fit beside the five of the paper.

Each is a change of the model by a number with a wide prior, fitted as a variant of the model is. The oblique
image of a mirror is sheared as well as scaled along x and y: the scalings along the diagonals differ
(*anamorphosis*). And the images of a pyramid may have moved since they were located (*pupil shift*): the
mirror then appears to have moved with them, and only the rims separate the two.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.results import Estimate
from escape_hw.api.synthetic_model import HasPupilShift, SyntheticModel
from escape_hw.config.choices import ExtraParameter
from escape_hw.errors import ConfigError

#: Prior standard deviations: shear in % of the diameter, shift of the images in % of a sub-aperture.
_SHEAR_SIGMA, _PUPIL_SHIFT_SIGMA = 2.0, 20.0
#: Zonal matrix ``(n_slopes, n_act)`` of the fitted profile of the influence functions, with the sensor of a
#: model, under a registration.
ProfileMatrix = Callable[[SyntheticModel, Registration], NDArray[np.float64]]
#: Value, in prior standard deviations, below which a symmetric difference about zero is used.
_SMALL_VALUE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Anamorphosis:
    """Shear of the mirror along x and y, in % of the diameter: see :meth:`Registration.with_shear`.

    Parameters
    ----------
    model, name, unit
        The synthetic model, name and unit of the parameter.
    prior_sigma
        Prior standard deviation about zero, in that unit.
    """

    model: SyntheticModel
    name: str = "anamorphosis"
    unit: str = "% of the diameter"
    prior_sigma: float = _SHEAR_SIGMA

    def systematic_error(self, registration_systematic_error: NDArray[np.float64]) -> float:
        """Systematic error: that of the scalings, of which the shear is one."""
        return float(registration_systematic_error[3:].max())

    def matrix_change(
        self, profile_matrix: ProfileMatrix, registration: Registration, scaled_value: float
    ) -> NDArray[np.float64]:
        """Change of the zonal matrix ``(n_slopes, n_act)`` per prior standard deviation.

        Parameters
        ----------
        profile_matrix, registration
            Matrix of the fitted profile, and the registration at which to change it.
        scaled_value
            Present value in prior standard deviations; multiplied with it the change is exact.
        """

        def at(value: float) -> NDArray[np.float64]:
            return profile_matrix(self.model, registration.with_shear(value * self.prior_sigma))

        if abs(scaled_value) < _SMALL_VALUE:
            return np.asarray((at(_SMALL_VALUE) - at(-_SMALL_VALUE)) / (2 * _SMALL_VALUE))
        return np.asarray((at(scaled_value) - at(0.0)) / scaled_value)


@dataclass(frozen=True, slots=True, eq=False)
class PupilShift:
    """Shift of all pupil images since they were located, along one axis, in % of a sub-aperture.

    Parameters
    ----------
    model, moved
        The model with the images as located, and shifted by one prior standard deviation along the axis.
    name, unit, prior_sigma
        As for :class:`Anamorphosis`.
    """

    model: SyntheticModel
    moved: SyntheticModel
    name: str
    unit: str = "% of a sub-aperture"
    prior_sigma: float = _PUPIL_SHIFT_SIGMA

    def systematic_error(self, registration_systematic_error: NDArray[np.float64]) -> float:
        """Zero: the systematic error of the registration is that of the images, whose shift is fitted."""
        return 0.0

    def matrix_change(
        self, profile_matrix: ProfileMatrix, registration: Registration, scaled_value: float
    ) -> NDArray[np.float64]:
        """As for :class:`Anamorphosis`, to first order."""
        return np.asarray(profile_matrix(self.moved, registration) - profile_matrix(self.model, registration))


#: A number that SPRINT fits beside the registration.
ExtraParameterModel = Anamorphosis | PupilShift


@dataclass(frozen=True, slots=True)
class FittedExtraParameter:
    """An extra parameter with its fitted value.

    Parameters
    ----------
    model
        The parameter.
    index
        Its index among all unknowns of the fit.
    scaled_value
        Its value in prior standard deviations.
    """

    model: ExtraParameterModel
    index: int
    scaled_value: float

    def to_estimate(
        self, sigma: NDArray[np.float64], registration_systematic_error: NDArray[np.float64]
    ) -> Estimate:
        """Value and standard error, from those of all unknowns and the systematic ones ``(5,)``."""
        statistical = float(sigma[self.index]) * self.model.prior_sigma
        return Estimate(
            self.scaled_value * self.model.prior_sigma,
            float(np.hypot(statistical, self.model.systematic_error(registration_systematic_error))),
            self.model.unit,
        )


def build_extra_parameters(
    model: SyntheticModel, names: Sequence[ExtraParameter]
) -> tuple[ExtraParameterModel, ...]:
    """Extra parameters by their names in the configuration; ``"pupil_shift"`` is one along x and one along y.

    Raises :class:`ConfigError` if the model has no pupil images that could be shifted.
    """
    parameters: list[ExtraParameterModel] = []
    if "anamorphosis" in names:
        parameters.append(Anamorphosis(model))
    if "pupil_shift" in names:
        if not isinstance(model, HasPupilShift):
            raise ConfigError(
                f"calibration.extra_parameters: the model '{model.name}' of this sensor has no shift of the "
                "pupil; it is for a pyramid and calibration.model = 'fast'"
            )
        parameters.append(PupilShift(model, model.with_pupil_shift(_PUPIL_SHIFT_SIGMA, 0.0), "pupil_shift_x"))
        parameters.append(PupilShift(model, model.with_pupil_shift(0.0, _PUPIL_SHIFT_SIGMA), "pupil_shift_y"))
    return tuple(parameters)


def build_fitted_extra_parameters(
    model: SyntheticModel, earlier: Iterable[str]
) -> tuple[ExtraParameterModel, ...]:
    """The parameters of an earlier fit, by the names of its estimates."""
    names: dict[ExtraParameter, None] = {}
    for name in earlier:
        names["pupil_shift" if name.startswith("pupil_shift") else "anamorphosis"] = None
    return build_extra_parameters(model, tuple(names))


def priors_from_fit(
    parameters: Sequence[ExtraParameterModel], earlier: Mapping[str, Estimate]
) -> tuple[tuple[float, float], ...]:
    """Prior mean and standard deviation of each parameter from earlier estimates, in default ones.

    A parameter without an earlier estimate keeps its default prior.
    """
    known = [(earlier.get(one.name), one.prior_sigma) for one in parameters]
    return tuple(
        (0.0, 1.0) if fit is None else (fit.value / wide, min(1.0, max(fit.sigma / wide, _SMALL_VALUE)))
        for fit, wide in known
    )
