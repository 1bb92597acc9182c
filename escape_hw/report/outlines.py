"""What was found on a sensor's frame, drawn over it; one function for each kind of sensor."""

from __future__ import annotations

from functools import singledispatch

import numpy as np
from matplotlib.axes import Axes
from matplotlib.patches import Circle, Rectangle

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid

_COLOUR = "#7fd6c0"


@singledispatch
def draw(grid: SensorGeometry, axes: Axes) -> str:
    """Draw a geometry into the axes of a frame.

    Returns
    -------
    str
        A few words on it, for the title.
    """
    raise TypeError(f"there is no drawing of a sensor of kind '{grid.kind}'")


@draw.register
def _lenslets(grid: SubApertureGrid, axes: Axes) -> str:
    half = grid.pitch_px / 2
    for x, y in grid.centres_px():
        square = Rectangle(
            (x - half, y - half), 2 * half, 2 * half, fill=False, ec=_COLOUR, lw=0.35, alpha=0.7
        )
        axes.add_patch(square)
    return f"{grid.n_valid} valid {grid.elements} of {grid.pitch_px:.2f} pixels"


@draw.register
def _pupils(grid: PyramidPupils, axes: Axes) -> str:
    n = grid.valid.shape[0]
    line = np.arange(n)
    for (x, y), (left, top) in zip(grid.centres_px, grid.corners_px, strict=True):
        axes.add_patch(Circle((x, y), grid.diameter_px / 2, fill=False, ec=_COLOUR, lw=0.8, alpha=0.9))
        axes.contour(left + line, top + line, grid.valid.astype(float), [0.5], colors=_COLOUR, linewidths=0.4)
        axes.plot(x, y, "+", color=_COLOUR, ms=5, mew=0.6)
    return f"four images of {grid.diameter_px:.1f} pixels, {grid.n_valid} valid {grid.elements}"
