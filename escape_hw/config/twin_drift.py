"""Configuration of what changes slowly in a twin: where the mirror sits, and how strong the turbulence is."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from escape_hw.api.registration import PARAMETERS
from escape_hw.config.section import Breach, Section, enforce

_Shift = Annotated[float, Field(ge=-500, le=500)]
_Turn = Annotated[float, Field(ge=-90, le=90)]
_Scaling = Annotated[float, Field(ge=-30, le=30)]


class TwinDriftRate(Section):
    """Steady drift of each parameter of the registration, from the moment the bench is switched on."""

    shift_x: _Shift = Field(0.0, description="% of a sub-aperture per second")
    shift_y: _Shift = Field(0.0, description="% of a sub-aperture per second")
    rotation: _Turn = Field(0.0, description="degrees per second")
    radial_scaling: _Scaling = Field(0.0, description="% of the diameter per second")
    tangential_scaling: _Scaling = Field(0.0, description="% of the diameter per second")


class TwinDriftSwing(Section):
    """Amplitude of a slow sinusoid of each parameter, which starts at zero."""

    shift_x: _Shift = Field(0.0, description="% of a sub-aperture")
    shift_y: _Shift = Field(0.0, description="% of a sub-aperture")
    rotation: _Turn = Field(0.0, description="degrees")
    radial_scaling: _Scaling = Field(0.0, description="% of the diameter")
    tangential_scaling: _Scaling = Field(0.0, description="% of the diameter")


class TwinDrift(Section):
    """Flexure: how the registration moves on from ``twin.registration`` (``rate t + swing sin``)."""

    rate: TwinDriftRate = Field(default_factory=TwinDriftRate, description="steady drift")
    swing: TwinDriftSwing = Field(default_factory=TwinDriftSwing, description="amplitude of the sinusoid")
    period_s: float = Field(600.0, ge=0.1, le=1e6, description="period of the sinusoid, seconds")

    @property
    def moves(self) -> bool:
        """Whether anything moves at all."""
        return any(getattr(part, name) for part in (self.rate, self.swing) for name in PARAMETERS)

    def way(self, time_s: float) -> list[float]:
        """How far each of the five parameters is from ``twin.registration`` at a time of the twin's clock."""
        turned = math.sin(2 * math.pi * time_s / self.period_s)
        return [getattr(self.rate, n) * time_s + getattr(self.swing, n) * turned for n in PARAMETERS]


class TwinSeeing(Section):
    """Fried parameter relative to its value at the start: ``1 + rate t + swing sin``, of plates and air."""

    rate: float = Field(0.0, ge=-1, le=1, description="steady change of r0 per second, fraction")
    swing: float = Field(0.0, ge=-0.95, le=0.95, description="amplitude of a sinusoid of r0, fraction")
    period_s: float = Field(600.0, ge=0.1, le=1e6, description="period of that sinusoid, seconds")
    least: float = Field(0.2, gt=0, le=1, description="r0 never falls below this, fraction of the start's")
    most: float = Field(5.0, ge=1, le=100, description="r0 never grows above this, fraction of the start's")

    @model_validator(mode="after")
    def _rules(self) -> Self:
        if 1 - abs(self.swing) < self.least:
            message = f"takes r0 below twin.seeing.least ({self.least:g}) in every period"
            enforce([Breach("swing", self.swing, message)])
        return self
