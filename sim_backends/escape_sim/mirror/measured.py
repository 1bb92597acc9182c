"""Influence functions given on a grid: measured, or computed by another model, under any registration."""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import TYPE_CHECKING, Self

import numpy as np
from numba import njit
from numpy.typing import DTypeLike, NDArray
from scipy import ndimage

from escape_hw.api.registration import PARAMETERS, Registration

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

#: Pixels by which the maps are continued, so that the splines do not ring at their edges.
_MARGIN = 4
#: Half steps of the differences that give the derivatives of the affine map, which is nearly linear:
#: registration in its units, and width.
_STEPS = (1e-2, 1e-2, 1e-3, 1e-2, 1e-2, 1e-4)


class MeasuredInfluenceFunctions:
    """Influence functions on a grid, interpolated by cubic splines.

    A registration shifts, rotates and stretches the whole surface, the shapes with the positions; a width
    stretches every shape about its actuator. The surface is zero outside the grid.

    Parameters
    ----------
    surfaces
        Surfaces per unit command ``(n_act, n_y, n_x)`` in fractions of full stroke.
    pixel_m
        Distance between grid points on the pupil in metres.
    gain
        Gain of each actuator, one number or ``(n_act,)``.
    positions_m
        Nominal positions ``(n_act, 2)`` as (x, y) on the pupil in metres, the centres of the widths; the
        centre of the mirror for all by default.
    centre_px
        Column and row of the mirror's centre; by default the middle of the grid.
    orientation
        Matrix ``(2, 2)`` that turns or mirrors (x, y) of the mirror to the directions of columns and rows;
        by default x is along columns, y along rows.
    place_sigma
        Standard errors of centre, orientation and pixel ``(5,)``: shifts in metres on the pupil, rotation in
        degrees, scalings in %.

    Raises
    ------
    ValueError
        The surfaces are not ``(n_act, n_y, n_x)`` or not finite, or the pixel is not positive.
    """

    def __init__(
        self,
        surfaces: NDArray[np.float64],
        pixel_m: float,
        gain: float | NDArray[np.float64] = 1.0,
        *,
        positions_m: NDArray[np.float64] | None = None,
        centre_px: tuple[float, float] | None = None,
        orientation: NDArray[np.float64] | None = None,
        place_sigma: Sequence[float] = (0.0, 0.0, 0.0, 0.0, 0.0),
    ) -> None:
        cube = np.asarray(surfaces, dtype=float)
        if cube.ndim != 3 or min(cube.shape) < 1:
            raise ValueError(f"the influence functions have shape {cube.shape}; it must be (n_act, n_y, n_x)")
        if not np.isfinite(cube).all() or not pixel_m > 0:
            raise ValueError(
                f"influence functions must be finite, and their pixel of {pixel_m} m must be positive"
            )
        scaled = cube * np.broadcast_to(np.asarray(gain, dtype=float), (len(cube),))[:, None, None]
        padded = np.pad(scaled, ((0, 0), (_MARGIN,) * 2, (_MARGIN,) * 2), mode="edge")
        self._splines = np.stack([ndimage.spline_filter(s, order=3, mode="mirror") for s in padded])
        self._size = np.array(cube.shape[:0:-1], dtype=float)
        self._centre = (self._size - 1) / 2 if centre_px is None else np.asarray(centre_px, dtype=float)
        self._to_pixels = (np.eye(2) if orientation is None else np.asarray(orientation)) / pixel_m
        self.positions_m = np.zeros((len(cube), 2)) if positions_m is None else np.asarray(positions_m)
        self.place_sigma = np.asarray(place_sigma, dtype=float)
        self.width = 1.0

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._splines)

    def with_width(self, width: float) -> Self:
        """The same functions, ``width`` times as wide."""
        wider = copy.copy(self)
        wider.width = width
        return wider

    def with_gain(self, gain: NDArray[np.float64]) -> Self:
        """The same functions with these gains ``(n_act,)``."""
        scaled = copy.copy(self)
        scaled._splines = self._splines * np.asarray(gain)[:, None, None]  # noqa: SLF001
        return scaled

    def surfaces(
        self,
        registration: Registration,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
    ) -> NDArray[np.float64]:
        """Surfaces per unit command ``(n_act, n_y, n_x)``, fractions of full stroke."""
        matrix, offset = self._pixel_map(registration, sub_aperture_m, self.width)
        out = np.zeros((1, y_m.size, x_m.size, self.n_act))
        none = np.zeros((0, 2, 2)), np.zeros((0, *offset.shape))
        _interpolate(self._splines, x_m, y_m, matrix, offset, *none, self._size - 1, out)
        return np.ascontiguousarray(np.moveaxis(out[0], 2, 0))

    def jacobian(
        self,
        registration: Registration,
        sub_aperture_m: float,
        x_m: NDArray[np.float64],
        y_m: NDArray[np.float64],
        actuators: slice,
        dtype: DTypeLike = np.float32,
    ) -> NDArray[np.floating]:
        """Surfaces of some actuators and their derivatives.

        Returns
        -------
        ndarray, ``(1 + 6, n_y, n_x, n)``
            The surfaces, then the derivatives by the five parameters of the registration, in their order and
            units, and by the width. They are exact for the splines.
        """
        point = np.append(registration.to_array(), self.width)

        def at(values: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
            five = dict(zip(PARAMETERS, values[:5].tolist(), strict=True))
            return self._pixel_map(replace(registration, **five), sub_aperture_m, float(values[5]))

        matrix, offset = at(point)
        by_matrix, by_offset = _central_differences(at, point)
        n = len(range(*actuators.indices(self.n_act)))
        out = np.zeros((1 + len(_STEPS), y_m.size, x_m.size, n), dtype)
        _interpolate(
            self._splines[actuators], x_m, y_m, matrix, offset[actuators], by_matrix, by_offset[:, actuators],
            self._size - 1, out,
        )  # fmt: skip
        return out

    def _pixel_map(
        self, registration: Registration, sub_aperture_m: float, width: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix ``(2, 2)`` and offset ``(n_act, 2)`` from the pupil to pixels of the padded maps."""
        affine, shift = registration.affine(sub_aperture_m)
        matrix = self._to_pixels @ np.linalg.inv(affine) / width
        own_centre = self.positions_m @ self._to_pixels.T * (1 - 1 / width)
        return matrix, own_centre - matrix @ shift + self._centre + _MARGIN


def _central_differences(
    function: Callable[[NDArray[np.float64]], tuple[NDArray[np.float64], NDArray[np.float64]]],
    point: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    derivatives = []
    for step in np.diag(_STEPS):
        above, below = function(point + step), function(point - step)
        derivatives.append([(a - b) / (2 * step.sum()) for a, b in zip(above, below, strict=True)])
    matrices, offsets = zip(*derivatives, strict=True)
    return np.stack(matrices), np.stack(offsets)


@njit(cache=True, nogil=True)
def _interpolate(splines, x, y, matrix, offset, by_matrix, by_offset, last, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Values and derivatives of splines ``(n, rows, columns)`` into ``out (1 + k, n_y, n_x, n)``.

    Actuator ``a`` is read at the pixel ``matrix @ (x, y) + offset[a]``, whose derivatives are
    ``by_matrix (k, 2, 2)`` and ``by_offset (k, n, 2)``. Half a pixel beyond the first and ``last`` pixels
    ``(2,)`` the surface ends.
    """
    wx, wy, dx, dy = np.empty(4), np.empty(4), np.empty(4), np.empty(4)
    low = _MARGIN - 0.5
    for a in range(splines.shape[0]):
        for i in range(y.size):
            for j in range(x.size):
                u = matrix[0, 0] * x[j] + matrix[0, 1] * y[i] + offset[a, 0]
                v = matrix[1, 0] * x[j] + matrix[1, 1] * y[i] + offset[a, 1]
                if not (low <= u <= last[0] + _MARGIN + 0.5 and low <= v <= last[1] + _MARGIN + 0.5):
                    continue
                column, row = int(np.floor(u)), int(np.floor(v))
                _weights(u - column, wx, dx)
                _weights(v - row, wy, dy)
                value, along_u, along_v = 0.0, 0.0, 0.0
                for p in range(4):
                    line, slope = 0.0, 0.0
                    for q in range(4):
                        coefficient = splines[a, row - 1 + p, column - 1 + q]
                        line += wx[q] * coefficient
                        slope += dx[q] * coefficient
                    value += wy[p] * line
                    along_u += wy[p] * slope
                    along_v += dy[p] * line
                out[0, i, j, a] = value
                for k in range(by_matrix.shape[0]):
                    du = by_matrix[k, 0, 0] * x[j] + by_matrix[k, 0, 1] * y[i] + by_offset[k, a, 0]
                    dv = by_matrix[k, 1, 0] * x[j] + by_matrix[k, 1, 1] * y[i] + by_offset[k, a, 1]
                    out[1 + k, i, j, a] = along_u * du + along_v * dv


@njit(cache=True, nogil=True)
def _weights(t, value, slope):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Cubic B-splines and their slopes at a fraction ``t`` of the interval (Unser 1999)."""
    s = 1 - t
    value[0], value[3] = s * s * s / 6, t * t * t / 6
    value[1] = 2 / 3 - t * t * (2 - t) / 2
    value[2] = 2 / 3 - s * s * (2 - s) / 2
    slope[0], slope[3] = -s * s / 2, t * t / 2
    slope[1] = t * (1.5 * t - 2)
    slope[2] = -s * (1.5 * s - 2)
