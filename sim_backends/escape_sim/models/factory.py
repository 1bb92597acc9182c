"""Factory of the synthetic model ``fast``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import SensorGeometry, SubApertureGrid, require_kind

if TYPE_CHECKING:
    from escape_hw.api.synthetic_model import SyntheticModel
    from escape_hw.config.system import SystemConfig


def make_fast_model(config: SystemConfig, grid: SensorGeometry | None) -> SyntheticModel:
    """Entry point ``fast``: the model of a system's sensor; without a grid, on the nominal one.

    Raises
    ------
    CalibrationError, ValueError
        The grid does not fit the design.
    """
    # Only the module of the sensor's kind is imported.
    if config.sensor.kind == "pyramid":
        from escape_sim.models.pyramid import PyramidModel, nominal_pupils

        pupils = nominal_pupils(config) if grid is None else require_kind(grid, PyramidPupils)
        return PyramidModel(config, pupils)
    from escape_sim.models.shack_hartmann import ShackHartmannModel, nominal_grid

    sub_apertures = nominal_grid(config) if grid is None else require_kind(grid, SubApertureGrid)
    return ShackHartmannModel(config, sub_apertures)
