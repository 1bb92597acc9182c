"""What a camera can be set to: its limits and increments, and the nearest it can do."""

from __future__ import annotations

import math
from dataclasses import dataclass

from escape_hw.api.camera import CameraSettings, Region
from escape_hw.errors import SettingRejected

#: The library's floats have 24 bits; so much and more is rounding.
TOLERANCE = 1e-5


@dataclass(frozen=True, slots=True)
class ParameterRange:
    """Smallest and largest value and increment of a parameter; 0: none."""

    low: float
    high: float
    step: float

    def nearest_valid(self, value: float) -> float:
        """The value on the grid of increments, within the limits; its own answer is a fixed point."""
        return (
            self._value_at_step(round((value - self.low) / self.step)) if self.step > 0 else self._clip(value)
        )

    def round_down(self, value: float) -> float:
        """The largest value on the grid that does not exceed ``value``, within the limits."""
        return self._value_at_step(self._n_steps(value)) if self.step > 0 else self._clip(value)

    def _clip(self, value: float) -> float:
        return min(max(value, self.low), self.high)

    def _n_steps(self, value: float) -> int:
        """Whole increments from the smallest value; a rounding error short of the next one counts as it."""
        return math.floor((value - self.low) / self.step + 1e-6)

    def _value_at_step(self, steps: int) -> float:
        return self.low + min(max(steps, 0), self._n_steps(self.high)) * self.step


@dataclass(frozen=True, slots=True)
class CameraLimits:
    """Limits of one camera as set up; exposure in microseconds, gain in decibels."""

    width: ParameterRange
    height: ParameterRange
    x_step: int
    y_step: int
    exposure: ParameterRange
    gain: ParameterRange

    def nearest_valid(self, device: str, want: CameraSettings, max_exposure_s: float) -> CameraSettings:
        """The nearest settings except the frame rate; exposures are at most ``max_exposure_s``.

        Raises
        ------
        SettingRejected
            The gain is outside its limits, or the region contains none of this camera.
        """
        low, high = self.gain.low, self.gain.high
        if not low - TOLERANCE <= want.gain_db <= high + TOLERANCE:
            raise SettingRejected(device, f"gain_db is {want.gain_db:g}; it must lie in {low:g}..{high:g}")
        exposure_us = self.exposure.nearest_valid(want.exposure_s * 1e6)
        if exposure_us > max_exposure_s * 1e6:
            exposure_us = self.exposure.round_down(max_exposure_s * 1e6)
        gain_db = self.gain.nearest_valid(want.gain_db)
        region = self._region(device, want.region)
        return CameraSettings(region, exposure_us * 1e-6, want.frame_rate_hz, gain_db)

    def _region(self, device: str, want: Region) -> Region:
        """The largest region on the sensor's increments within the requested one."""
        left, top = _next_multiple(want.x, self.x_step), _next_multiple(want.y, self.y_step)
        width, height = want.x + want.width - left, want.y + want.height - top
        if width < self.width.low or height < self.height.low:
            raise SettingRejected(
                device,
                f"{want} contains no region of this camera, which has at least {self.width.low:g} x "
                f"{self.height.low:g} pixels, x in steps of {max(1, self.x_step)} and y of "
                f"{max(1, self.y_step)}; enlarge it",
            )
        return Region(left, top, round(self.width.round_down(width)), round(self.height.round_down(height)))


def _next_multiple(value: int, step: int) -> int:
    """The smallest multiple of ``step`` (0: none) that is not below ``value``."""
    return value + -value % max(1, step)
