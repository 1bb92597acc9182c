"""Arguments that hold a calibration: results, loaded products, and matrices with their geometry."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING, TypeAlias, Union

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry

if TYPE_CHECKING:
    from escape_hw.io.fits.matrix import MatrixProduct

#: What ``calibrate`` or ``load_matrix`` returns.
CalibrationLike: TypeAlias = Union[CalibrationResult, "MatrixProduct"]

_EXPECTED = "a calibration as returned by calibrate() or escape_hw.load_matrix() is needed"
#: Attributes of other results that hold a calibration.
_CONTAINERS = ("rescaled_calibration", "latest")


def as_calibration(value: object) -> CalibrationResult:
    """The calibration itself, or that of a loaded product.

    Raises
    ------
    TypeError
        The value is something else; the message names its type and the remedy.
    """
    if isinstance(value, CalibrationResult):
        return value
    result = getattr(value, "result", None)
    if isinstance(result, CalibrationResult):
        return result
    raise TypeError(f"{_EXPECTED}, not a {type(value).__name__}{_suggestion(value)}")


def as_matrix_and_grid(
    value: InteractionMatrix | CalibrationLike, grid: SensorGeometry | None
) -> tuple[InteractionMatrix, SensorGeometry]:
    """A matrix and its sensor geometry; a given ``grid`` takes precedence over that of a calibration.

    Raises
    ------
    TypeError
        A matrix without a grid, or neither a matrix nor a calibration.
    """
    if not isinstance(value, InteractionMatrix):
        found = as_calibration(value)
        return found.matrix, found.grid if grid is None else grid
    if grid is None:
        raise TypeError(f"a matrix alone has no sensor geometry: give the grid as well, or {_EXPECTED}")
    return value, grid


def _suggestion(value: object) -> str:
    if isinstance(value, str | os.PathLike):
        return f"; read it: escape_hw.load_matrix({os.fspath(value)!r})"
    if isinstance(value, InteractionMatrix):
        return "; a matrix alone has no sensor geometry"
    for name in _CONTAINERS:
        if hasattr(value, name):
            return f"; take its .{name}"
    return ""
