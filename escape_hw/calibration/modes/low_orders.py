"""Tip, tilt, focus and single modes of a given wavefront, as modal coefficients."""

from __future__ import annotations

import re
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import ConfigError

_MODE = re.compile(r"mode (\d+)")


def combine_low_orders(
    terms: Mapping[str, float],
    m2c: NDArray[np.float64],
    positions: NDArray[np.float64],
    nm_per_unit: float,
) -> NDArray[np.float64]:
    """Modal coefficients ``(n_modes,)`` of a sum of terms.

    Parameters
    ----------
    terms
        Nanometres rms wavefront by name: ``tip`` (along x), ``tilt`` (along y), ``focus``, ``mode N`` with N
        from 1. The amplitudes are exact for an orthonormal basis, such as Karhunen-Loève modes.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    positions
        Actuator positions ``(n_act, 2)``.
    nm_per_unit
        Wavefront rms of a coefficient of 1.

    Raises
    ------
    ConfigError
        There is no such term.
    """
    x, y = (positions - positions.mean(axis=0)).T
    r2 = x**2 + y**2
    shapes = {"tip": x, "tilt": y, "focus": r2 - r2.mean()}
    total = np.zeros(m2c.shape[1])
    for name, wavefront_nm in terms.items():
        match = _MODE.fullmatch(name)
        if name in shapes:
            part = np.linalg.lstsq(m2c, shapes[name], rcond=None)[0]
        elif match is not None and 1 <= int(match[1]) <= total.size:
            part = np.eye(total.size)[int(match[1]) - 1]
        else:
            raise ConfigError(
                f"there is no term '{name}'; write tip, tilt, focus, or mode 1 to mode {total.size}"
            )
        norm = float(np.linalg.norm(part))
        if norm == 0:
            raise ConfigError(f"the basis does not contain {name}")
        total += part * (wavefront_nm / (nm_per_unit * norm))
    return total
