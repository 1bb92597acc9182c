"""Matrices as scripts hand them over: measured, read from disk, or with their geometry apart."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeAlias, Union

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry

if TYPE_CHECKING:
    from escape_hw.io.fits import MatrixProduct

#: What ``calibrate`` or ``load_matrix`` returns.
Calibrated: TypeAlias = Union[CalibrationResult, "MatrixProduct"]

_NEEDED = "what calibrate() or escape_hw.load_matrix() returns is needed"
#: Results with a calibration in them, which their reader has to choose.
_WITHIN = ("rescaled", "latest")


def calibration_of(given: object) -> CalibrationResult:
    """A calibration, be it one or a product that holds one.

    Raises
    ------
    TypeError
        It is something else; says which, and the way out.
    """
    if isinstance(given, CalibrationResult):
        return given
    held = getattr(given, "result", None)
    if isinstance(held, CalibrationResult):
        return held
    raise TypeError(f"{_NEEDED}, not a {type(given).__name__}{_way_out(given)}")


def matrix_and_grid(
    given: InteractionMatrix | Calibrated, grid: SensorGeometry | None
) -> tuple[InteractionMatrix, SensorGeometry]:
    """A matrix and the geometry that it belongs to; a grid that is given goes before a calibration's own.

    Raises
    ------
    TypeError
        A matrix without its geometry, or neither a matrix nor a calibration; says the way out.
    """
    if not isinstance(given, InteractionMatrix):
        found = calibration_of(given)
        return found.matrix, found.grid if grid is None else grid
    if grid is None:
        raise TypeError(f"a matrix alone does not tell its geometry: give the grid as well, or {_NEEDED}")
    return given, grid


def _way_out(given: object) -> str:
    if isinstance(given, str | os.PathLike):
        return f"; read it: escape_hw.load_matrix({os.fspath(given)!r})"
    if isinstance(given, InteractionMatrix):
        return "; a matrix alone does not tell its geometry"
    for name in _WITHIN:
        if hasattr(given, name):
            return f"; take its .{name}"
    return ""
