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

from escape_hw.api.model import MovablePupil, SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.api.results import Measured
from escape_hw.config.models import Extra
from escape_hw.errors import ConfigError

#: Prior scatter: the shear in % of the diameter, and the images' shift in % of a sub-aperture.
_SHEAR, _PUPIL_SHIFT = 2.0, 20.0
#: Shares of the prior scatter below which a difference is taken about zero.
_NEAR = 0.01


@dataclass(frozen=True, slots=True, eq=False)
class Anamorphosis:
    """Shear of the mirror along x and y, in % of the diameter: see :meth:`Registration.sheared`.

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
    scatter: float = _SHEAR

    def doubt(self, registration_doubt: NDArray[np.float64]) -> float:
        """What the model's own error adds: as much as to the scalings, of which a shear is one."""
        return float(registration_doubt[3:].max())

    def per_share(self, registration: Registration, width: float, share: float) -> NDArray[np.float64]:
        """Change of the zonal matrix ``(n_slopes, n_act)`` per prior scatter.

        Parameters
        ----------
        registration, width
            As for :meth:`~escape_hw.api.model.SyntheticModel.zonal_matrix`.
        share
            Present value in prior scatters; times this the change is exact.
        """

        def at(value: float) -> NDArray[np.float64]:
            return self.model.zonal_matrix(registration.sheared(value * self.scatter), width)

        if abs(share) < _NEAR:
            return np.asarray((at(_NEAR) - at(-_NEAR)) / (2 * _NEAR))
        return np.asarray((at(share) - self.model.zonal_matrix(registration, width)) / share)


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
    scatter: float = _PUPIL_SHIFT

    def doubt(self, registration_doubt: NDArray[np.float64]) -> float:
        """Nothing: a registration is in doubt because the images are, whose shift is told here."""
        return 0.0

    def per_share(self, registration: Registration, width: float, share: float) -> NDArray[np.float64]:
        """As for :class:`Anamorphosis`, to first order: images are not made anew for every share."""
        here = self.model.zonal_matrix(registration, width)
        return np.asarray(self.moved.zonal_matrix(registration, width) - here)


#: A number that SPRINT fits beside the registration.
ExtraUnknown = Anamorphosis | PupilShift


@dataclass(frozen=True, slots=True)
class FoundExtra:
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

    unknown: ExtraUnknown
    place: int
    share: float

    def measured(self, sigma: NDArray[np.float64], registration_doubt: NDArray[np.float64]) -> Measured:
        """With its standard error, from those of all unknowns and the model's own of the registration."""
        unknown = self.unknown
        told = float(sigma[self.place]) * unknown.scatter
        return Measured(
            self.share * unknown.scatter,
            float(np.hypot(told, unknown.doubt(registration_doubt))),
            unknown.unit,
        )


def family_of(name: str) -> Extra:
    """What an unknown is asked for with: ``"pupil_shift"`` for one along x or along y."""
    return "pupil_shift" if name.startswith("pupil_shift") else "anamorphosis"


def extra_unknowns(model: SyntheticModel, also: Sequence[Extra]) -> tuple[ExtraUnknown, ...]:
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
    found: list[ExtraUnknown] = []
    if "anamorphosis" in also:
        found.append(Anamorphosis(model))
    if "pupil_shift" in also:
        if not isinstance(model, MovablePupil):
            raise ConfigError(
                f"calibration.also: the model '{model.name}' of this sensor knows no shift of the pupil; "
                "it is for a pyramid and calibration.model = 'fast'"
            )
        found.append(PupilShift(model, model.with_pupil_shift(_PUPIL_SHIFT, 0.0), "pupil_shift_x"))
        found.append(PupilShift(model, model.with_pupil_shift(0.0, _PUPIL_SHIFT), "pupil_shift_y"))
    return tuple(found)


def unknowns_told(model: SyntheticModel, told: Iterable[str]) -> tuple[ExtraUnknown, ...]:
    """The unknowns that an earlier fit has told of, by their names; raises as :func:`extra_unknowns`."""
    return extra_unknowns(model, tuple(dict.fromkeys(map(family_of, told))))


def as_told(
    unknowns: Sequence[ExtraUnknown], told: Mapping[str, Measured]
) -> tuple[tuple[float, float], ...]:
    """Mean and scatter of each unknown in its own prior scatters, as an earlier fit has told them.

    Parameters
    ----------
    unknowns
        Which.
    told
        The earlier fit's values by name. What it told nothing of keeps its wide prior about zero.
    """
    known = [(told.get(one.name), one.scatter) for one in unknowns]
    return tuple(
        (0.0, 1.0) if fit is None else (fit.value / wide, min(1.0, max(fit.sigma / wide, _NEAR)))
        for fit, wide in known
    )
