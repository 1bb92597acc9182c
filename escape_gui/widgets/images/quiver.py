"""Slopes as arrows over an image, drawn as one path, and the outlines of sub-apertures."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray

from escape_gui.theme import Theme
from escape_hw.remote.state import Geometry

#: Up to this number, outlines are the circular pupils of a pyramid sensor.
_MAX_PUPILS = 8
#: Length of the arrow of a slope of one pixel, in half widths of a sub-aperture.
_ARROW_SCALE = 0.8


class Quiver(pg.PlotCurveItem):  # type: ignore[misc]
    """Arrows that start at the centres of the sub-apertures."""

    def __init__(self, theme: Theme) -> None:
        super().__init__()
        self._theme = theme
        self._x = self._y = np.zeros(0)
        self._length = 1.0
        self.setZValue(4)
        self.setVisible(False)
        theme.changed.connect(self.apply_theme)
        self.apply_theme()

    def set_geometry(self, geometry: Geometry) -> None:
        outlines = np.asarray(geometry.outlines_px, float).reshape(-1, 3)
        self._x, self._y = outlines[:, 0], outlines[:, 1]
        self._length = _ARROW_SCALE * float(outlines[:, 2].mean()) if len(outlines) else 1.0
        self.setData([], [])

    def show_slopes(self, slopes: NDArray[np.floating]) -> None:
        """Show slopes ``(2 * n,)`` in pixels, all x, then all y; nothing if their number does not match."""
        n = self._x.size
        if slopes.size != 2 * n or n == 0:
            self.setData([], [])
            return
        x, y = np.repeat(self._x, 2), np.repeat(self._y, 2)
        x[1::2] += self._length * slopes[:n]
        y[1::2] += self._length * slopes[n:]
        self.setData(x, y, connect="pairs")

    def apply_theme(self) -> None:
        self.setPen(pg.mkPen(self._theme.series(0), width=1))


def outline_points(outlines: Sequence[tuple[float, float, float]]) -> NDArray[np.float64]:
    """Squares around sub-apertures, or circles around the pupils of a pyramid sensor.

    Parameters
    ----------
    outlines
        Centre x, y and half width of each, in pixels.

    Returns
    -------
    ndarray
        Points ``(2, n_points)``, NaN between the outlines.
    """
    circles = len(outlines) <= _MAX_PUPILS
    angle = np.linspace(0, 2 * np.pi, 49) if circles else np.pi / 4 + np.linspace(0, 2 * np.pi, 5)
    radius = 1.0 if circles else np.sqrt(2)
    shape = np.append(radius * np.exp(1j * angle), np.nan)
    table = np.asarray(outlines, float).reshape(-1, 3)
    points = (table[:, :1] + 1j * table[:, 1:2] + table[:, 2:] * shape).ravel()
    return np.stack([points.real, points.imag])
