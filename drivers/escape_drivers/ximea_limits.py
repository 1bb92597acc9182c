"""What a XIMEA camera can be set to: its limits and increments, and the nearest it can do."""

from __future__ import annotations

import math
from dataclasses import dataclass

from escape_drivers.ximea_library import XimeaLibrary
from escape_hw.api.frames import CameraSettings, Region
from escape_hw.errors import SettingRejected

#: The library's floats have 24 bits; so much and more is rounding.
ROUNDING = 1e-5


@dataclass(frozen=True, slots=True)
class Range:
    """Smallest and largest value and increment of a parameter; 0: none."""

    low: float
    high: float
    step: float

    @classmethod
    def of_real(cls, library: XimeaLibrary, name: str) -> Range:
        """Limits of a floating-point parameter."""
        low, high, step = (library.real(f"{name}:{part}") for part in ("min", "max", "inc"))
        return cls(low, high, _shortest(step))

    @classmethod
    def of_whole(cls, library: XimeaLibrary, name: str) -> Range:
        """Limits of an integer parameter."""
        return cls(*(library.whole(f"{name}:{part}") for part in ("min", "max", "inc")))

    def nearest(self, value: float) -> float:
        """The value on the grid of increments, within the limits; its own answer is a fixed point."""
        return self._on_grid(round((value - self.low) / self.step)) if self.step > 0 else self._within(value)

    def below(self, value: float) -> float:
        """The largest value on the grid that does not exceed ``value``, within the limits."""
        return self._on_grid(self._steps(value)) if self.step > 0 else self._within(value)

    def _within(self, value: float) -> float:
        return min(max(value, self.low), self.high)

    def _steps(self, value: float) -> int:
        """Whole increments from the smallest value; a rounding error short of the next one counts as it."""
        return math.floor((value - self.low) / self.step + 1e-6)

    def _on_grid(self, steps: int) -> float:
        return self.low + min(max(steps, 0), self._steps(self.high)) * self.step


@dataclass(frozen=True, slots=True)
class XimeaLimits:
    """Limits of one camera as set up; exposure in microseconds, gain in decibels."""

    width: Range
    height: Range
    x_step: int
    y_step: int
    exposure: Range
    gain: Range

    @classmethod
    def read(cls, library: XimeaLibrary) -> XimeaLimits:
        """Ask the camera; its region must begin at the corner of the sensor, or it would shrink the limits."""
        return cls(
            Range.of_whole(library, "width"),
            Range.of_whole(library, "height"),
            library.whole("offsetX:inc"),
            library.whole("offsetY:inc"),
            Range.of_real(library, "exposure"),
            Range.of_real(library, "gain"),
        )

    def region(self, want: Region) -> Region:
        """The largest region on the sensor's increments that reaches no further than asked, where possible."""
        width, height = round(self.width.below(want.width)), round(self.height.below(want.height))
        x = min(want.x, round(self.width.high) - width)
        y = min(want.y, round(self.height.high) - height)
        return Region(x - x % max(1, self.x_step), y - y % max(1, self.y_step), width, height)

    def exposure_s(self, want_s: float, longest_s: float) -> float:
        """Exposure time that fits into a frame."""
        us = self.exposure.nearest(want_s * 1e6)
        return (us if us <= longest_s * 1e6 else self.exposure.below(longest_s * 1e6)) * 1e-6

    def gain_db(self, device: str, want_db: float) -> float:
        """Gain on its increments.

        Raises
        ------
        SettingRejected
            Outside its limits.
        """
        low, high = self.gain.low, self.gain.high
        if not low - ROUNDING <= want_db <= high + ROUNDING:
            raise SettingRejected(device, f"gain_db is {want_db:g}; it must lie in {low:g}..{high:g}")
        return self.gain.nearest(want_db)


def rate_refused(device: str, want: CameraSettings, fastest_hz: float) -> SettingRejected:
    """The error for a frame rate that is out of reach."""
    return SettingRejected(
        device,
        f"frame_rate_hz is {want.frame_rate_hz:g}; {want.region.height} rows and an exposure of "
        f"{want.exposure_s:g} s allow at most {fastest_hz:.1f}",
    )


def _shortest(step: float) -> float:
    """A single-precision increment as the decimal number that was meant: 0.1, not 0.10000000149."""
    return float(f"{step:.7g}")
