"""Measured influence functions of a deformable mirror under any registration."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from astropy.io import fits
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.api.registration import Registration
from escape_hw.errors import ConfigError


class MeasuredInfluence:
    """Influence functions as measured on a grid, read between its points by cubic splines.

    A registration moves, turns and stretches the whole surface, the shapes with the positions.
    Beyond the measured square a surface is zero.

    Parameters
    ----------
    surfaces
        Surfaces per unit command ``(n_act, n, n)`` in fractions of full stroke; x along columns, y
        along rows, the mirror's centre in the middle of the array.
    pixel_m
        Distance between its points on the pupil in metres.
    gain
        Gain of each actuator, one number or ``(n_act,)``.

    Raises
    ------
    ValueError
        Not a stack of squares of finite numbers.
    """

    def __init__(
        self, surfaces: NDArray[np.float64], pixel_m: float, gain: float | NDArray[np.float64] = 1.0
    ) -> None:
        cube = np.asarray(surfaces, dtype=float)
        if cube.ndim != 3 or cube.shape[1] != cube.shape[2] or min(cube.shape) < 1:
            raise ValueError(f"influence functions of shape {cube.shape}; they must be (n_act, n, n)")
        if not np.isfinite(cube).all() or not pixel_m > 0:
            raise ValueError(
                f"influence functions are not all finite, or their pixel of {pixel_m} m is not positive"
            )
        scaled = cube * np.broadcast_to(np.asarray(gain, dtype=float), (len(cube),))[:, None, None]
        # A margin of zeros, so that a spline does not ring at the edge of what was measured.
        self._margin = 4
        padded = np.pad(scaled, ((0, 0), (self._margin,) * 2, (self._margin,) * 2))
        self._splines = np.stack([ndimage.spline_filter(s, order=3, mode="mirror") for s in padded])
        self._n, self._pixel = cube.shape[1], pixel_m

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._splines)

    def surfaces(
        self,
        registration: Registration,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Surfaces per unit command ``(n_act, n_y, n_x)``, fractions of full stroke.

        Parameters
        ----------
        registration, sub_aperture_m
            Registration and the size of a sub-aperture in metres that its shifts refer to.
        x_m, y_m
            Columns' and rows' coordinates ``(n_x,)`` and ``(n_y,)`` in metres.
        """
        matrix, offset = registration.affine(sub_aperture_m)
        x, y = np.meshgrid(x_m, y_m)
        at = np.linalg.solve(matrix, np.stack([x.ravel() - offset[0], y.ravel() - offset[1]]))
        places = at[::-1] / self._pixel + (self._n - 1) / 2 + self._margin
        out = np.empty((self.n_act, y_m.size, x_m.size))
        for number, spline in enumerate(self._splines):
            read = ndimage.map_coordinates(
                spline, places, order=3, mode="constant", cval=0.0, prefilter=False
            )
            out[number] = read.reshape(out.shape[1:])
        return out


def read_influence(file: str, n_act: int) -> NDArray[np.float64]:
    """Influence functions ``(n_act, n, n)`` from the first image of a FITS file.

    Raises
    ------
    ConfigError
        The file cannot be read, or holds something else.
    """
    path = Path(file).expanduser()
    try:
        cube = np.asarray(fits.getdata(path), dtype=float)
    except (OSError, TypeError, ValueError, IndexError) as error:
        raise ConfigError(f"influence functions cannot be read from {path}: {error}") from error
    if cube.ndim != 3 or cube.shape[1] != cube.shape[2] or len(cube) != n_act:
        raise ConfigError(
            f"{path} holds an array of shape {cube.shape}; influence functions of {n_act} actuators "
            f"have the shape ({n_act}, n, n)"
        )
    if not np.isfinite(cube).all():
        raise ConfigError(f"{path} holds influence functions that are not finite")
    return cube
