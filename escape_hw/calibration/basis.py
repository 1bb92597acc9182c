"""The modal basis that a configuration asks for, on a mirror whose influence functions are given."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.mode_shapes import fourier, zernike
from escape_hw.calibration.modes import karhunen_loeve, unit_rms, zonal
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Outer scale of the turbulence assumed for the modal basis, in pupil diameters.
_OUTER_SCALE = 4.0
#: Bases that need nothing but the influence functions.
_OF_SURFACES = {"zonal": zonal, "zernike": zernike, "fourier": fourier}


def configured_basis(
    config: SystemConfig,
    surfaces: NDArray[np.float64],
    pupil: NDArray[np.bool_],
    pixel_m: float,
    disabled: Sequence[int],
) -> NDArray[np.float64]:
    """Mode-to-command matrix ``(n_act, n_modes)``, each column of unit rms surface.

    Disabled actuators take no part: the modes are those of the others.

    Parameters
    ----------
    config
        Its ``basis`` says which.
    surfaces, pupil, pixel_m
        Influence functions ``(n_act, n, n)`` in fractions of full stroke, the pupil ``(n, n)`` and the
        size of a pixel in metres.
    disabled
        Actuators that must not move.

    Raises
    ------
    ConfigError
        The basis of a file has other actuators or too few modes, or moves disabled actuators.
    CalibrationError
        More modes than the actuators that work can make.
    """
    basis = config.basis
    works = np.ones(surfaces.shape[0], dtype=bool)
    works[list(disabled)] = False
    if basis.kind in _OF_SURFACES:
        return _spread_over(works, _OF_SURFACES[basis.kind](surfaces[works], pupil, basis.n_modes))
    if basis.kind == "file":
        # Imported here: astropy takes a second to load, and only this needs it.
        from escape_hw.io.basis import load_basis

        m2c = load_basis(basis.file)
        if m2c.shape[0] != surfaces.shape[0] or m2c.shape[1] < basis.n_modes:
            raise ConfigError(
                f"basis.file holds {m2c.shape[0]} actuators and {m2c.shape[1]} modes; "
                f"{surfaces.shape[0]} and at least {basis.n_modes} are needed"
            )
        if m2c[~works, : basis.n_modes].any():
            raise ConfigError(
                "the modes of basis.file move actuators that devices.dm.limits.disabled keeps at zero"
            )
        return unit_rms(m2c[:, : basis.n_modes], surfaces, pupil)
    outer_scale_m = _OUTER_SCALE * config.system.pupil_m
    return _spread_over(works, karhunen_loeve(surfaces[works], pupil, pixel_m, basis.n_modes, outer_scale_m))


def _spread_over(works: NDArray[np.bool_], m2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Modes of the actuators that work as modes of the whole mirror."""
    whole = np.zeros((works.size, m2c.shape[1]))
    whole[works] = m2c
    return whole
