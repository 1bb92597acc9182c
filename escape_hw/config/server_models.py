"""Configuration of a server: when it loses patience."""

from __future__ import annotations

from pydantic import Field

from escape_hw.config.section import Section


class ServerSection(Section):
    """Limits of ``escape serve``; all of them make the mirror safe, but for the first."""

    lease_s: float = Field(
        5.0, ge=1.5, le=600, description="a client that may write and is silent for so long loses that right"
    )
    abandoned_s: float = Field(
        10.0, ge=0.5, le=3600, description="time after which a procedure that nobody holds is aborted"
    )
    silent_s: float = Field(
        10.0,
        ge=2,
        le=600,
        description="an engine that says nothing for so long, its mirror not flat, is ended",
    )
    no_frames_s: float = Field(2.0, ge=0.2, le=600, description="longest time without a frame in closed loop")
    saturated_share: float = Field(
        0.2, gt=0, le=1, description="share of the actuators at their limits that counts as saturated"
    )
    saturated_s: float = Field(
        1.0, ge=0.2, le=600, description="longest time with saturated actuators in closed loop"
    )
    diverging_factor: float = Field(
        4.0, gt=1, le=1000, description="growth of the residual, beside its median, that counts as diverging"
    )
    diverging_s: float = Field(1.0, ge=0.2, le=600, description="longest time with a diverging residual")
