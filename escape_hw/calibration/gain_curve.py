"""Optical gains that differ between modes, as a few coefficients of a smooth curve.

On a pyramid the gain of a mode depends on its spatial frequency, which in a Karhunen-Loeve basis goes
with the square root of its number. Legendre polynomials in that, from the first on, bend the curve; the
common gain is none of their business.
"""

from __future__ import annotations

import numpy as np
from numpy.polynomial import legendre
from numpy.typing import NDArray

#: Prior scatter of the coefficients, relative to the common gain: slope, bend, S-shape.
SCATTER = (0.3, 0.15, 0.08)


def curve_basis(n_modes: int, coefficients: int = len(SCATTER)) -> NDArray[np.float64]:
    """Curves over the modes per standard deviation of their coefficient ``(coefficients, n_modes)``.

    Parameters
    ----------
    n_modes
        Number of modes, in the order of a Karhunen-Loeve basis.
    coefficients
        How many, at most as many as :data:`SCATTER` has.
    """
    x = np.sqrt(np.arange(1, n_modes + 1))
    x = (2 * x - x[0] - x[-1]) / max(x[-1] - x[0], 1.0)
    each = np.diag((0.0, *SCATTER))[1 : coefficients + 1]
    return np.stack([legendre.legval(x, one) for one in each]) if coefficients else np.zeros((0, n_modes))


def bends_of(m2c: NDArray[np.float64], basis: NDArray[np.float64]) -> list[NDArray[np.float64]]:
    """What turns a command into the change that each curve makes of it ``(n_act, n_act)``.

    Parameters
    ----------
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    basis
        From :func:`curve_basis`.
    """
    to_modes = np.linalg.pinv(m2c)
    return [(m2c * curve) @ to_modes for curve in basis]
