"""Protocols of the synthetic model that SPRINT inverts, and of its optional capabilities."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration


@runtime_checkable
class SyntheticModel(Protocol):
    """A model of mirror and sensor that computes interaction matrices for any registration.

    It contains the nominal design only, never the true state of a twin.
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
        """Models that differ from this one by one standard deviation of an uncertain property.

        SPRINT fits the share of each difference, so that the property does not bias the registration and
        its errors include it. Empty if no property is uncertain.
        """
        ...


@runtime_checkable
class HasSystematicError(Protocol):
    """A model with a systematic error of its own registration."""

    @property
    def registration_systematic_error(self) -> NDArray[np.float64]:
        """Standard errors of the origin of the registration ``(5,)``, in its units.

        They cannot be estimated from a matrix; SPRINT adds them to its errors.
        """
        ...


@runtime_checkable
class HasGainTrend(Protocol):
    """A model with an uncertain trend of the slope gains over the pupil."""

    @property
    def gain_trend(self) -> float:
        """Prior standard deviation of the relative change of a slope gain from centre to rim, or 0."""
        ...


@runtime_checkable
class HasSlopeWeights(Protocol):
    """A model that provides a weight per slope, small where the model does not apply."""

    @property
    def slope_weights(self) -> NDArray[np.float64]:
        """Weight of the squared residual of every slope ``(n_slopes,)``, in (0, 1]."""
        ...


@runtime_checkable
class HasPupilShift(Protocol):
    """A model that computes the effect of a shift of the pupil on the sensor."""

    def with_pupil_shift(self, shift_x: float, shift_y: float) -> SyntheticModel:
        """The model with pupil and mirror shifted on the sensor.

        Parameters
        ----------
        shift_x, shift_y
            In % of a sub-aperture, positive to higher columns and rows.
        """
        ...


@runtime_checkable
class DifferentiableModel(SyntheticModel, Protocol):
    """A synthetic model that also computes single modes, and analytic derivatives.

    SPRINT needs no more than :class:`SyntheticModel`, but is many times faster with this. The functions of
    :mod:`escape_hw.calibration.modes.derivatives` accept either. Derivatives are by the five parameters of
    the registration, in their order and units, and by the width.
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
            ``zonal_matrix(registration, width) @ m2c``, at least to single precision.
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
