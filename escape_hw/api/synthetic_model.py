"""Interface of the synthetic models that SPRINT inverts."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol, Self, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.flips import Flip
from escape_hw.api.registration import Registration


@runtime_checkable
class SyntheticModel(Protocol):
    """A model of mirror and sensor that gives interaction matrices at any registration.

    It depends on the nominal design only, never on the true state of a twin.
    """

    @property
    def name(self) -> str:
        """Name of the model in products."""

    @property
    def n_act(self) -> int:
        """Number of actuators."""

    @property
    def sub_aperture_m(self) -> float:
        """Size of a sub-aperture on the pupil in metres."""

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

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command of each actuator.

        Parameters
        ----------
        registration
            Registration of the mirror.
        width
            Width of the influence functions relative to nominal.

        Returns
        -------
        ndarray, ``(n_slopes, n_act)``
            In the slope unit of the sensor, all x then all y over the valid sub-apertures.
        """

    def variants(self) -> Sequence[Self]:
        """Models that differ from this one by one standard deviation of an uncertain parameter.

        SPRINT fits the amplitude of each difference, which removes its bias from the registration and adds
        its uncertainty to the standard errors. Empty if there is no such parameter.
        """


@runtime_checkable
class HasActuatorPositions(Protocol):
    """A model that knows where the actuators are."""

    @property
    def actuator_positions_m(self) -> NDArray[np.float64]:
        """Nominal positions of the actuators ``(n_act, 2)`` as (x, y) on the pupil in metres."""
        ...


#: Widths, relative to nominal, of the functions whose sum is a radial profile.
PROFILE_WIDTHS = (1.0, 0.35, 0.6, 1.7, 2.9)


@runtime_checkable
class HasProfile(Protocol):
    """A model whose nominal influence function is a sum of one function at several widths, or any other."""

    @property
    def profile_shares(self) -> tuple[float, ...]:
        """Share of the function at each of :data:`PROFILE_WIDTHS`; empty for any other shape."""

    def component_model(self) -> SyntheticModel:
        """The same model with the function alone as the nominal influence function."""


@runtime_checkable
class HasSurfaces(Protocol):
    """A model that gives the surfaces of its influence functions."""

    def surface_model(self, x_m: NDArray[np.float64], y_m: NDArray[np.float64]) -> SyntheticModel:
        """The same mirror on a sensor of heights instead of slopes.

        Parameters
        ----------
        x_m, y_m
            Coordinates ``(n_x,)`` and ``(n_y,)`` of a grid on the pupil in metres.

        Returns
        -------
        SyntheticModel
            Its zonal matrix has the heights of the grid points, row by row, per unit command ``(n_y * n_x,
            n_act)`` in fractions of full stroke.
        """


@runtime_checkable
class HasSystematicError(Protocol):
    """A model with a systematic error of the origin of its registration."""

    @property
    def registration_systematic_error(self) -> NDArray[np.float64]:
        """Standard errors of the origin of the registration ``(5,)``, in its units.

        SPRINT adds them to its standard errors, because no interaction matrix shows them.
        """


@runtime_checkable
class HasNumberingOffsets(Protocol):
    """A model whose sub-apertures may be numbered wrongly on the camera."""

    @property
    def numbering_offsets(self) -> tuple[tuple[int, int], tuple[int, int]]:
        """Competing numberings, see :class:`~escape_hw.api.sensor.SubApertureGrid`."""


@runtime_checkable
class HasOrientation(Protocol):
    """A model that knows the configured orientation of the camera and numbering of the actuators."""

    def suggest_orientation(self, flip: Flip, *, opposite: bool) -> str:
        """What to configure so that images are turned further, and commands have the other sign.

        Parameters
        ----------
        flip
            Applied to the images as they are now.
        opposite
            Whether the sign of commands changes.
        """


@runtime_checkable
class HasGainTrend(Protocol):
    """A model with an uncertain radial trend of the slope gains."""

    @property
    def gain_trend(self) -> float:
        """Prior standard deviation of the relative change of slope gain from centre to rim; 0: none."""


@runtime_checkable
class HasSlopeWeights(Protocol):
    """A model with a weight per slope, low where the model does not apply."""

    @property
    def slope_weights(self) -> NDArray[np.float64]:
        """Weights of the squared slopes ``(n_slopes,)``, in (0, 1]."""


@runtime_checkable
class HasPupilShift(Protocol):
    """A model that can shift the pupil on the sensor."""

    def with_pupil_shift(self, shift_x: float, shift_y: float) -> SyntheticModel:
        """The model with pupil and mirror shifted on the sensor.

        Parameters
        ----------
        shift_x, shift_y
            In % of a sub-aperture, positive towards higher columns and rows.
        """


@runtime_checkable
class HasPokeResponse(Protocol):
    """A model whose response depends on the shapes of the random pokes of the measurement."""

    def around_pokes(
        self, registration: Registration, m2c: NDArray[np.float64], overlap: float
    ) -> SyntheticModel | None:
        """The model whose response is the mean around random pokes of modes ``m2c (n_act, n_modes)``.

        ``None`` if that makes no difference, or the measurement had no random pokes. The registration is
        where the pokes are computed, not that of the model returned. ``overlap`` is the share of an exposure
        during which the mirror still has the poke before.
        """


@runtime_checkable
class DifferentiableModel(SyntheticModel, Protocol):
    """A synthetic model with modal matrices and analytic derivatives.

    Optional: SPRINT is many times faster with it. The functions of
    :mod:`escape_hw.calibration.modes.derivatives` accept either kind. Derivatives are with respect to the
    five parameters of the registration, in their order and units, and to the width.
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
            Width of the influence functions relative to nominal.

        Returns
        -------
        ndarray, ``(n_slopes, n_modes)``
            ``zonal_matrix(registration, width) @ m2c``, at least in single precision.
        """

    def modal_jacobian(
        self, registration: Registration, m2c: NDArray[np.float64], width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slopes per unit of each mode ``(n_slopes, n_modes)``, derivatives ``(6, n_slopes, n_modes)``."""

    def zonal_jacobian(
        self, registration: Registration, width: float = 1.0
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slopes per unit command ``(n_slopes, n_act)``, and derivatives ``(6, n_slopes, n_act)``."""


@runtime_checkable
class SummingModel(SyntheticModel, Protocol):
    """A synthetic model that computes sums of influence functions faster than their matrices one by one."""

    def zonal_sum(
        self, functions: Sequence[tuple[NDArray[np.float64] | float, Registration, float]]
    ) -> NDArray[np.float64]:
        """Slopes of a sum of influence functions per unit command ``(n_slopes, n_act)``.

        Parameters
        ----------
        functions
            Factor, a number or ``(n_act,)``, registration and width of each.
        """

    def zonal_components(
        self, registration: Registration, width: float, functions: Sequence[tuple[float, float]]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Slopes of influence functions of several widths, and derivatives of their sum, per unit command.

        Parameters
        ----------
        registration, width
            Registration, and the width that all functions are multiples of.
        functions
            Factor in the sum and relative width of each.

        Returns
        -------
        matrices : ndarray, ``(n_functions, n_slopes, n_act)``
            Without the factors.
        derivatives : ndarray, ``(6, n_slopes, n_act)``
            By the five parameters of the registration, in their units, and by the width.
        """
