"""The model's matrix of the mirror as it was found, rather than of the one of the drawing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.departures import PEDESTAL
from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.api.results import RegistrationEstimate
from escape_hw.calibration.derivatives import modal_jacobian, modal_matrix, pedestal_jacobian
from escape_hw.calibration.extra_unknowns import unknowns_told


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
        What SPRINT found of it, extra unknowns included; without departures, the drawing's mirror at the
        estimated width.
    m2c
        Modes ``(n_act, n_modes)``.
    """
    acted = _acted(estimate, m2c)
    return _whole(modal_matrix(model, here, acted, estimate.width.value), model, here, estimate, acted)


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
    acted = _acted(estimate, m2c)
    unit, derivatives = modal_jacobian(model, here, acted, width)
    open_to = np.zeros_like(unit)
    if apart is not None:
        share, single = apart.pedestal, model.zonal_matrix(here, width)
        derivatives = derivatives + share * (pedestal_jacobian(model, here, width, acted)[1] - derivatives)
        single = single + share * (model.zonal_matrix(here, width * PEDESTAL) - single)
        open_to = np.square(single) @ np.square(apart.gain_sigma[:, None] * m2c)
    return _whole(unit, model, here, estimate, acted), derivatives, open_to


def _acted(estimate: RegistrationEstimate, m2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modes as actuators of unequal gains make them ``(n_act, n_modes)``."""
    apart = estimate.departures
    return m2c if apart is None else (1 + apart.gain)[:, None] * m2c


def _whole(
    unit: NDArray[np.float64],
    model: SyntheticModel,
    here: Registration,
    estimate: RegistrationEstimate,
    acted: NDArray[np.float64],
) -> NDArray[np.float64]:
    """A matrix with what extra unknowns add to it, and unequal widths and the pedestal to first order."""
    apart, width = estimate.departures, estimate.width.value
    for one in unknowns_told(model, estimate.extras):
        share = estimate.extras[one.name].value / one.scatter
        unit = unit + share * (one.per_share(here, width, share) @ acted)
    if apart is None:
        return unit
    share, wider = apart.pedestal, apart.width[:, None] * acted
    broad = modal_matrix(model, here, acted, width * PEDESTAL) - modal_matrix(model, here, acted, width)
    own = modal_jacobian(model, here, wider, width)[1][5]
    unequal = own + share * (pedestal_jacobian(model, here, width, wider)[1][5] - own)
    return np.asarray(unit + share * broad + width * unequal)
