"""Arrows over a picture, all drawn as one path."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pyqtgraph as pg
from numpy.typing import NDArray

from escape_gui.theme import Theme
from escape_hw.remote.state import Geometry

#: So few outlines are pupils of a pyramid, which are round.
_PUPILS = 8
#: Length of an arrow of one pixel, in half widths of a sub-aperture.
_PER_PIXEL = 0.8


class Quiver(pg.PlotCurveItem):  # type: ignore[misc]
    """Arrows at the sub-apertures' centres; a dot of the shaft's width marks where each begins."""

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
        """Take the centres; only lenslet sensors have one for each slope."""
        places = np.asarray(geometry.outlines_px, float).reshape(-1, 3)
        self._x, self._y = places[:, 0], places[:, 1]
        self._length = _PER_PIXEL * float(places[:, 2].mean()) if len(places) else 1.0
        self.setData([], [])

    def show_slopes(self, slopes: NDArray[np.floating]) -> None:
        """Show slopes ``(2 n,)`` in pixels, all x and then all y."""
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
    """Squares around sub-apertures or circles around a pyramid's pupils ``(2, points)``, NaN between them."""
    round_ones = len(outlines) <= _PUPILS
    angle = np.linspace(0, 2 * np.pi, 49) if round_ones else np.pi / 4 + np.linspace(0, 2 * np.pi, 5)
    size = 1.0 if round_ones else np.sqrt(2)
    shape = np.append(size * np.exp(1j * angle), np.nan)
    places = np.asarray(outlines, float).reshape(-1, 3)
    points = (places[:, :1] + 1j * places[:, 1:2] + places[:, 2:] * shape).ravel()
    return np.stack([points.real, points.imag])
