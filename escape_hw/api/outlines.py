"""Outlines of sub-apertures and pupil images on the sensor's camera, for displays."""

from __future__ import annotations

from functools import singledispatch

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid


@singledispatch
def outlines(grid: SensorGeometry) -> tuple[tuple[float, float, float], ...]:
    """Outlines on the camera: (x, y, half width) in pixels each."""
    raise TypeError(f"a sensor of kind '{grid.kind}' has no outlines")


@outlines.register
def _sub_apertures(grid: SubApertureGrid) -> tuple[tuple[float, float, float], ...]:
    half = grid.pitch_px / 2
    return tuple((float(x), float(y), half) for x, y in grid.centres_px())


@outlines.register
def _pupils(grid: PyramidPupils) -> tuple[tuple[float, float, float], ...]:
    return tuple((float(x), float(y), grid.diameter_px / 2) for x, y in grid.centres_px)
