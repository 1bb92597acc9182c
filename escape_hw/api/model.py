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
