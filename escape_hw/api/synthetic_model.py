"""The synthetic model that SPRINT inverts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration


@runtime_checkable
class SyntheticModel(Protocol):
    """A model of mirror and sensor that yields interaction matrices under any registration.

    It knows the nominal design only. It never sees a twin's hidden truth.
    """

    @property
    def name(self) -> str:
        """Name of the model, as written into products."""
        ...

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        ...

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture on the pupil in metres."""
        ...

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions for the modal basis.

        Returns
        -------
        surfaces : ndarray, ``(n_act, n, n)``
            Surface per unit command, in fractions of full stroke.
        pupil : ndarray of bool, ``(n, n)``
        pixel_m : float
            Pixel size on the pupil in metres.
        """
        ...

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command of each actuator.

        Parameters
        ----------
        registration
            Registration of the mirror.
        width
            Scale of the influence functions' width relative to nominal.

        Returns
        -------
        ndarray, ``(n_slopes, n_act)``
            In the sensor's slope unit, all x then all y over the valid sub-apertures.
        """
        ...

    def variants(self) -> Sequence[Self]:
        """Models that differ from this one by one standard deviation of something uncertain.

        SPRINT fits how much of each difference the data hold, so that the registration does not pay
        for it and its errors know of it. Empty when the model is sure of itself.
        """
        ...


@runtime_checkable
class HasSystematicError(Protocol):
    """A model whose place on the sensor is itself known with an error only."""

    @property
    def registration_systematic_error(self) -> NDArray[np.float64]:
        """Standard errors of where the registration counts from ``(5,)``, in its units.

        No matrix shows them; SPRINT adds them to its errors.
        """
        ...


@runtime_checkable
class HasGainTrend(Protocol):
    """A model whose slopes may answer more at the rim of the pupil than it says, or less."""

    @property
    def gain_trend(self) -> float:
        """Prior scatter of a trend: relative change of a slope's gain from the centre to the rim, or 0."""
        ...


@runtime_checkable
class HasSlopeWeights(Protocol):
    """A model that knows which sub-apertures it is no model of."""

    @property
    def slope_weights(self) -> NDArray[np.float64]:
        """Weight of every slope's squares ``(n_slopes,)``, in (0, 1]."""
        ...


@runtime_checkable
class HasPupilShift(Protocol):
    """A model that knows what its matrices become when the pupil stands elsewhere on the sensor."""

    def with_pupil_shift(self, shift_x: float, shift_y: float) -> SyntheticModel:
        """The same sensor with the pupil shifted on it, and the mirror with the pupil.

        Parameters
        ----------
        shift_x, shift_y
            In % of a sub-aperture, positive to higher columns and rows.
        """
        ...


@runtime_checkable
class DifferentiableModel(SyntheticModel, Protocol):
    """A synthetic model that also gives few modes at a time, and its derivatives in closed form.

    Nothing more is needed of a model than :class:`SyntheticModel`; with this SPRINT is many times
    faster. The functions of :mod:`escape_hw.calibration.modes.derivatives` take either. Derivatives are by
    the five parameters of the registration, in their order and units, and by the width.
    """

    def modal_matrix(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> NDArray[np.float64]:
        """Slopes per unit of each mode.

        Parameters
        ----------
        registration
            Registration of the mirror.
        m2c
            Mode-to-command matrix ``(n_act, n_modes)``.
        width
            Scale of the influence functions' width relative to nominal.

        Returns
        -------
        ndarray, ``(n_slopes, n_modes)``
            ``zonal_matrix(registration, width) @ m2c``, to single precision at least.
        """
        ...

    def modal_jacobian(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slopes per unit of each mode ``(n_slopes, n_modes)``, derivatives ``(6, n_slopes, n_modes)``."""
        ...

    def zonal_jacobian(
        self, registration: Registration, width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slopes per unit command ``(n_slopes, n_act)``, and derivatives ``(6, n_slopes, n_act)``."""
        ...
