"""Configuration of a telescope's pupil."""

from __future__ import annotations

from typing import Annotated, Self

from pydantic import Field, model_validator

from escape_hw.config.section import Breach, Listed, Section, enforce


class TelescopeSection(Section):
    """What stands in the light before the pupil; ``system.pupil_m`` is its diameter."""

    obscuration: float = Field(
        0.0, ge=0, le=0.95, description="diameter of the central obscuration, fraction of the pupil's"
    )
    spider_m: float = Field(0.0, ge=0, le=10, description="width of the vanes that hold it, metres")
    spiders_deg: Listed[tuple[Annotated[float, Field(ge=-360, le=360)], ...]] = Field(
        (), description="where each vane points from the centre, degrees from +x towards +y"
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        if self.spiders_deg and not self.spider_m:
            enforce([Breach("spider_m", self.spider_m, "the vanes of spiders_deg need a width")])
        return self
