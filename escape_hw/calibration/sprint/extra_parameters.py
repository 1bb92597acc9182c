"""What SPRINT may fit beside the five parameters of the paper, where the data carry it.

Each is a change of the model by a number with a wide prior, fitted as a variant of the model is. A
mirror seen askew is not only scaled along x and y but sheared: the scalings along the diagonals differ
(*anamorphosis*). And the images of a pyramid may have moved since they were found (*pupil shift*): the
mirror then seems to have moved with them, and only the rims tell the two apart.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.results import Estimate
from escape_hw.api.synthetic_model import HasPupilShift, SyntheticModel
from escape_hw.config.choices import ExtraParameter
from escape_hw.errors import ConfigError

#: Prior scatter: the shear in % of the diameter, and the images' shift in % of a sub-aperture.
_SHEAR_SIGMA, _PUPIL_SHIFT_SIGMA = 2.0, 20.0
#: Shares of the prior scatter below which a difference is taken about zero.
_SMALL_VALUE = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Anamorphosis:
    """Shear of the mirror along x and y, in % of the diameter: see :meth:`Registration.with_shear`.

    Parameters
    ----------
    model
        Gives matrices under any registration.
    name, unit
        What it is called, and what it is measured in.
    scatter
        Prior standard deviation about zero, in that unit.
    """

    model: SyntheticModel
    name: str = "anamorphosis"
    unit: str = "% of the diameter"
    prior_sigma: float = _SHEAR_SIGMA

    def systematic_error(self, registration_systematic_error: NDArray[np.float64]) -> float:
        """What the model's own error adds: as much as to the scalings, of which a shear is one."""
        return float(registration_systematic_error[3:].max())

    def matrix_change(
        self, registration: Registration, width: float, scaled_value: float
    ) -> NDArray[np.float64]:
        """Change of the zonal matrix ``(n_slopes, n_act)`` per prior scatter.

        Parameters
        ----------
        registration, width
            As for :meth:`~escape_hw.api.synthetic_model.SyntheticModel.zonal_matrix`.
        share
            Present value in prior scatters; times this the change is exact.
        """

        def at(value: float) -> NDArray[np.float64]:
            return self.model.zonal_matrix(registration.with_shear(value * self.prior_sigma), width)

        if abs(scaled_value) < _SMALL_VALUE:
            return np.asarray((at(_SMALL_VALUE) - at(-_SMALL_VALUE)) / (2 * _SMALL_VALUE))
        return np.asarray((at(scaled_value) - self.model.zonal_matrix(registration, width)) / scaled_value)


@dataclass(frozen=True, slots=True, eq=False)
class PupilShift:
    """Shift of all pupil images from where they were found, along one axis, in % of a sub-aperture.

    Parameters
    ----------
    model, moved
        With the images where they were found, and one prior scatter further along the axis.
    name, unit, scatter
        As for :class:`Anamorphosis`.
    """

    model: SyntheticModel
    moved: SyntheticModel
    name: str
    unit: str = "% of a sub-aperture"
    prior_sigma: float = _PUPIL_SHIFT_SIGMA

    def systematic_error(self, registration_systematic_error: NDArray[np.float64]) -> float:
        """Nothing: a registration is in doubt because the images are, whose shift is told here."""
        return 0.0

    def matrix_change(
        self, registration: Registration, width: float, scaled_value: float
    ) -> NDArray[np.float64]:
        """As for :class:`Anamorphosis`, to first order: images are not made anew for every share."""
        unshifted = self.model.zonal_matrix(registration, width)
        return np.asarray(self.moved.zonal_matrix(registration, width) - unshifted)


#: A number that SPRINT fits beside the registration.
ExtraParameterModel = Anamorphosis | PupilShift


@dataclass(frozen=True, slots=True)
class FittedExtraParameter:
    """An extra unknown as it was found.

    Parameters
    ----------
    unknown
        Which.
    place
        Its place among all unknowns of the fit.
    share
        Its value in prior scatters.
    """

    unknown: ExtraParameterModel
    index: int
    scaled_value: float

    def to_estimate(
        self, sigma: NDArray[np.float64], registration_systematic_error: NDArray[np.float64]
    ) -> Estimate:
        """With its standard error, from those of all unknowns and the model's own of the registration."""
        unknown = self.unknown
        earlier = float(sigma[self.index]) * unknown.prior_sigma
        return Estimate(
            self.scaled_value * unknown.prior_sigma,
            float(np.hypot(earlier, unknown.systematic_error(registration_systematic_error))),
            unknown.unit,
        )


def option_name_of(name: str) -> ExtraParameter:
    """What an unknown is asked for with: ``"pupil_shift"`` for one along x or along y."""
    return "pupil_shift" if name.startswith("pupil_shift") else "anamorphosis"


def build_extra_parameters(
    model: SyntheticModel, also: Sequence[ExtraParameter]
) -> tuple[ExtraParameterModel, ...]:
    """The unknowns that go by some names.

    Parameters
    ----------
    model
        The synthetic model.
    also
        ``"anamorphosis"``, ``"pupil_shift"`` (one along x and one along y).

    Raises
    ------
    ConfigError
        The model has no images that could be shifted.
    """
    parameters: list[ExtraParameterModel] = []
    if "anamorphosis" in also:
        parameters.append(Anamorphosis(model))
    if "pupil_shift" in also:
        if not isinstance(model, HasPupilShift):
            raise ConfigError(
                f"calibration.extra_parameters: the model '{model.name}' of this sensor knows no shift of the pupil; "
                "it is for a pyramid and calibration.model = 'fast'"
            )
        parameters.append(PupilShift(model, model.with_pupil_shift(_PUPIL_SHIFT_SIGMA, 0.0), "pupil_shift_x"))
        parameters.append(PupilShift(model, model.with_pupil_shift(0.0, _PUPIL_SHIFT_SIGMA), "pupil_shift_y"))
    return tuple(parameters)


def build_fitted_extra_parameters(
    model: SyntheticModel, earlier: Iterable[str]
) -> tuple[ExtraParameterModel, ...]:
    """The unknowns that an earlier fit has told of, by their names; raises as :func:`build_extra_parameters`."""
    return build_extra_parameters(model, tuple(dict.fromkeys(map(option_name_of, earlier))))


def priors_from_fit(
    unknowns: Sequence[ExtraParameterModel], earlier: Mapping[str, Estimate]
) -> tuple[tuple[float, float], ...]:
    """Mean and scatter of each unknown in its own prior scatters, as an earlier fit has told them.

    Parameters
    ----------
    unknowns
        Which.
    told
        The earlier fit's values by name. What it told nothing of keeps its wide prior about zero.
    """
    known = [(earlier.get(one.name), one.prior_sigma) for one in unknowns]
    return tuple(
        (0.0, 1.0) if fit is None else (fit.value / wide, min(1.0, max(fit.sigma / wide, _SMALL_VALUE)))
        for fit, wide in known
    )
