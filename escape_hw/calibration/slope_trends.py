"""Smooth changes of the slopes' gains over the pupil, which random gains of single slopes do not expect."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.model import SyntheticModel, UnevenModel


def slope_trends(model: SyntheticModel, valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """What gains of slopes change by over the pupil, for one prior scatter of each trend.

    Thousands of slopes would each have to depart from an independent prior to follow a trend, and some
    actuators and a scaling follow it at less cost. So trends have unknowns of their own: the squares of
    the places along x and y, apart in the x and the y slopes. Linear ones, tried too, pass for shifts.

    Parameters
    ----------
    model
        Says how much its slopes may trend (:class:`~escape_hw.api.model.UnevenModel`); one that does not
        say so is even.
    valid
        Valid sub-apertures ``(n_rows, n_columns)``.

    Returns
    -------
    ndarray, ``(n_slopes, 4)``
        Relative, of zero mean; ``(n_slopes, 0)`` for a model that is even.
    """
    count = int(valid.sum())
    scatter = model.gain_trend if isinstance(model, UnevenModel) else 0.0
    if not scatter:
        return np.zeros((2 * count, 0))
    places = np.argwhere(valid)[:, ::-1]
    half = np.array(valid.shape[::-1]) / 2
    squares = np.square((places + 0.5) / half - 1)
    return scatter * np.kron(np.eye(2), squares - squares.mean(axis=0))
