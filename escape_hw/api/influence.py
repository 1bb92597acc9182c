"""Influence functions of a mirror as estimated from a calibration."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr

#: FITS cards of the errors of the place: shifts in metres, rotation in degrees, scalings in %.
PLACE_CARDS = ("ERR_SHX", "ERR_SHY", "ERR_ROT", "ERR_RAD", "ERR_TAN")
#: Card of the primary header: whether the model of the fit fits. Absent where it is not judged.
MODEL_FITS_CARD = "MODELFIT"


@dataclass(frozen=True, slots=True, eq=False)
class InfluenceProfile:
    """Radial profile of the influence functions, relative to the peak of an inner actuator.

    Parameters
    ----------
    radius
        Distance from the actuator in pitches ``(n,)``.
    nominal
        Profile of the nominal influence function ``(n,)``.
    fitted, sigma
        Fitted profile of the inner actuators and its standard errors ``(n,)``; the peak is 1 by definition.
    edge, edge_sigma
        The same of the edge actuators, along the edge ``(n,)``; empty where the model has no positions.
    """

    radius: NDArray[np.float64]
    nominal: NDArray[np.float64]
    fitted: NDArray[np.float64]
    sigma: NDArray[np.float64]
    edge: NDArray[np.float64]
    edge_sigma: NDArray[np.float64]
    __repr__ = short_repr


@dataclass(frozen=True, slots=True, eq=False)
class InfluenceEstimate:
    """Estimated influence functions of all actuators, relative to the common gain.

    Parameters
    ----------
    surfaces, sigma
        Surface per unit command in fractions of full stroke, and its standard errors ``(n_act, n_y, n_x)``.
    x_m, y_m
        Coordinates of columns and rows from the centre of the mirror, in metres on the pupil.
    pitch_m
        Distance between actuators in metres on the pupil.
    positions_m, positions_sigma_m
        Fitted positions of the actuators and their standard errors ``(n_act, 2)`` as (x, y), likewise.
    gain, gain_sigma
        Relative gain of each actuator beyond the common one ``(n_act,)``.
    edge
        True for edge actuators, which have a shape of their own ``(n_act,)``.
    profile
        Radial profile.
    place_sigma
        Standard errors of the place on the mirror ``(5,)``: shifts in metres on the pupil, rotation in
        degrees, scalings in %. They are those of the registration, from which the shape is not independent.
    model_fits
        Whether the model of the fit fits to within the noise; ``None`` where it is not judged.
    """

    surfaces: NDArray[np.float64]
    sigma: NDArray[np.float64]
    x_m: NDArray[np.float64]
    y_m: NDArray[np.float64]
    pitch_m: float
    positions_m: NDArray[np.float64]
    positions_sigma_m: NDArray[np.float64]
    gain: NDArray[np.float64]
    gain_sigma: NDArray[np.float64]
    edge: NDArray[np.bool_]
    profile: InfluenceProfile
    place_sigma: NDArray[np.float64]
    model_fits: bool | None = None
    __repr__ = short_repr
