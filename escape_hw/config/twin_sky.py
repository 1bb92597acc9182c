"""Configuration of what is outside a telescope: its air and its star; and of what spoils its pupil."""

from __future__ import annotations

import math
from typing import Annotated, Self

from pydantic import Field, model_validator

from escape_hw.config.section import Breach, Listed, Section, enforce

_Fraction = Annotated[float, Field(gt=0, le=1)]
_Speed = Annotated[float, Field(ge=0, le=200)]
_Degrees = Annotated[float, Field(ge=-360, le=360)]


class TwinAtmosphere(Section):
    """Open-air turbulence in layers, one entry of each list per layer."""

    r0_m: float = Field(gt=0, le=100, description="Fried parameter of all layers at 500 nm, metres")
    outer_scale_m: float = Field(gt=0, le=1e7, description="outer scale, metres")
    fraction: Listed[tuple[_Fraction, ...]] = Field(
        min_length=1, max_length=20, description="share of each layer in the turbulence, sums to 1"
    )
    speed_m_s: Listed[tuple[_Speed, ...]] = Field(
        description="wind speed of each layer, metres per second across the pupil"
    )
    direction_deg: Listed[tuple[_Degrees, ...]] = Field(
        description="where the wind of each layer blows to, degrees from +x towards +y"
    )
    boiling_s: Annotated[float, Field(allow_inf_nan=True)] = Field(
        math.inf,
        ge=0.02,
        description="time in which moving air forgets its shape (to 1/e), seconds; inf: never",
    )

    @model_validator(mode="after")
    def _rules(self) -> Self:
        n = len(self.fraction)
        breaches = [
            Breach(key, list(value), f"needs one entry for each of the {n} layers, has {len(value)}")
            for key, value in (("speed_m_s", self.speed_m_s), ("direction_deg", self.direction_deg))
            if len(value) != n
        ]
        total = sum(self.fraction)
        if abs(total - 1) > 1e-3:
            breaches.append(Breach("fraction", list(self.fraction), f"sums to {total:.6g}, not 1"))
        enforce(breaches)
        return self


class TwinStar(Section):
    """The star that the sensor looks at; takes the place of ``twin.wfs.photons_per_frame``."""

    magnitude: float = Field(ge=-30, le=30, description="magnitude of the star in the sensor's band")
    zero_point: float = Field(
        ge=0, le=40, description="magnitude of a star that gives one photo-electron per second in all"
    )
    sky_magnitude: float | None = Field(
        None, ge=0, le=40, description="sky brightness, magnitudes per square arcsecond; absent: dark"
    )
    field_arcsec: float = Field(
        2.0, gt=0, le=600, description="diameter of the sensor's round field of view, arcseconds"
    )

    def electrons(self, exposure_s: float) -> float:
        """Photo-electrons from the star in an exposure, over the whole sensor."""
        return float(10 ** (0.4 * (self.zero_point - self.magnitude)) * exposure_s)

    def sky_electrons(self, exposure_s: float) -> float:
        """Photo-electrons from the sky in an exposure, over the whole sensor."""
        if self.sky_magnitude is None:
            return 0.0
        area = math.pi / 4 * self.field_arcsec**2
        return float(10 ** (0.4 * (self.zero_point - self.sky_magnitude)) * area * exposure_s)


class TwinContamination(Section):
    """Dust and uneven light on the pupil, which the configuration's design part knows nothing of.

    Actuators that had to be switched off because of it are known: ``devices.dm.limits.disabled``.
    """

    edge_share: float = Field(
        0.0, ge=0, le=1, description="contaminated share of the pupil's circumference, fraction"
    )
    angle_deg: float = Field(
        0.0, ge=-360, le=360, description="middle of the contaminated arc, degrees from +x towards +y"
    )
    depth: float = Field(
        0.15, gt=0, le=1, description="how far it reaches inwards, fraction of the pupil's radius"
    )
    transmission: float = Field(
        1.0, ge=0, le=1, description="share of the light that passes the contaminated part"
    )
    unevenness: float = Field(
        0.0, ge=0, le=0.5, description="smooth scatter of the light over the pupil, rms fraction"
    )
    edge_unevenness: float = Field(
        0.0,
        ge=0,
        le=0.2,
        description="scatter of the pupil's radius around its circumference, rms fraction of the radius",
    )
