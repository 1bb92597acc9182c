"""Sensor geometry for synthetic models, and the factory of the model ``fast``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, require_kind
from escape_sim.models.pyramid import PyramidModel, nominal_pupils
from escape_sim.models.shack_hartmann import ShackHartmannModel, nominal_grid

if TYPE_CHECKING:
    from escape_hw.api.synthetic_model import SyntheticModel
    from escape_hw.config.system import SystemConfig


def model_geometry(config: SystemConfig, grid: SensorGeometry | None) -> PyramidPupils | SubApertureGrid:
    """The given geometry, checked for the sensor's kind, or the design's nominal one."""
    if config.sensor.kind == "pyramid":
        return nominal_pupils(config) if grid is None else require_kind(grid, PyramidPupils)
    return nominal_grid(config) if grid is None else require_kind(grid, SubApertureGrid)


def make_fast_model(config: SystemConfig, grid: SensorGeometry | None) -> SyntheticModel:
    """Entry point ``fast``: the model of a system's sensor; without a grid, on the nominal one.

    Raises
    ------
    CalibrationError, ValueError
        The grid does not fit the design.
    """
    geometry = model_geometry(config, grid)
    if isinstance(geometry, PyramidPupils):
        return PyramidModel(config, geometry)
    return ShackHartmannModel(config, geometry)
