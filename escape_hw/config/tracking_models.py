"""Configuration of the tracker."""

from __future__ import annotations

from pydantic import Field

from escape_hw.config.section import Section


class TrackingSection(Section):
    """How ``escape track`` follows a drifting system."""

    poke: float = Field(
        0.00025,
        gt=0,
        le=0.1,
        description="pokes in the closed loop are uniform in +-poke, rms surface as fraction of full stroke",
    )
    memory_s: float = Field(
        10.0, ge=1, le=1e5, description="time in which old frames fade to 1/e in the live registration"
    )
    worth: float = Field(
        0.01,
        gt=0,
        le=1,
        description="relative change of the matrix from which on a new one is worth an exchange",
    )
    limit: float = Field(
        0.3,
        gt=0,
        le=10,
        description="largest relative change of the matrix that is exchanged without asking",
    )
    largest_shift: float = Field(
        100.0,
        gt=0,
        le=1000,
        description="shift since the start that needs a new calibration, % of a sub-aperture",
    )
