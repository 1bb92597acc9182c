"""The model's matrix of the mirror as it was found, rather than of the one of the drawing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.departures import PEDESTAL, MirrorDepartures
from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.api.results import RegistrationEstimate
from escape_hw.calibration.derivatives import modal_jacobian, modal_matrix


def found_matrix(
    model: SyntheticModel, here: Registration, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Slopes per unit of each mode ``(n_slopes, n_modes)`` of the mirror that was found, at unit gain.

    Departures belong to actuators, so any basis will do, not only the one that was measured.

    Parameters
    ----------
    model
        The synthetic model.
    here
        Where the mirror sits.
    estimate
        What SPRINT found of it; without departures, the drawing's mirror at the estimated width.
    m2c
        Modes ``(n_act, n_modes)``.
    """
    apart, width = estimate.departures, estimate.width.value
    if apart is None:
        return modal_matrix(model, here, m2c, width)
    acted = (1 + apart.gain)[:, None] * m2c
    return modal_matrix(model, here, acted, width) + _reshaped(model, here, apart, acted, width)


def found_jacobian(
    model: SyntheticModel, estimate: RegistrationEstimate, m2c: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """The matrix at the estimated registration, its derivatives, and what unequal actuators leave open.

    Parameters
    ----------
    model, estimate, m2c
        As for :func:`found_matrix`.

    Returns
    -------
    matrix : ndarray, ``(n_slopes, n_modes)``
    derivatives : ndarray, ``(6, n_slopes, n_modes)``
        By the five parameters of the registration and by the width.
    variance : ndarray, ``(n_slopes, n_modes)``
        Of the matrix, from the errors of the actuators' gains; 0 without departures.
    """
    here, apart, width = estimate.registration, estimate.departures, estimate.width.value
    if apart is None:
        unit, derivatives = modal_jacobian(model, here, m2c, width)
        return unit, derivatives, np.zeros_like(unit)
    acted = (1 + apart.gain)[:, None] * m2c
    unit, derivatives = modal_jacobian(model, here, acted, width)
    open_to = np.square(model.zonal_matrix(here, width)) @ np.square(apart.gain_sigma[:, None] * m2c)
    return unit + _reshaped(model, here, apart, acted, width), derivatives, open_to


def _reshaped(
    model: SyntheticModel,
    here: Registration,
    apart: MirrorDepartures,
    acted: NDArray[np.float64],
    width: float,
) -> NDArray[np.float64]:
    """What unequal widths and the pedestal add to modes' slopes, to first order."""
    unequal = modal_jacobian(model, here, apart.width[:, None] * acted, width)[1][5] * width
    broad = modal_matrix(model, here, acted, width * PEDESTAL) - modal_matrix(model, here, acted, width)
    return np.asarray(unequal + apart.pedestal * broad)
