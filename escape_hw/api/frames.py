"""What cameras deliver and how they are set."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.brief import brief


@dataclass(frozen=True, slots=True, eq=False)
class Frame:
    """One camera frame.

    Parameters
    ----------
    data
        Counts ``(rows, columns)``, uint16, read-only, and not overwritten by later frames.
    index
        The device's own frame counter; a step larger than one is a lost frame.
    exposed_ns, arrived_ns
        Monotonic time of the end of the exposure and of the arrival in this computer.
    n_saturated
        Number of pixels at the top of the scale.
    """

    data: NDArray[np.uint16]
    index: int
    exposed_ns: int
    arrived_ns: int
    n_saturated: int = 0
    __repr__ = brief


@dataclass(frozen=True, slots=True)
class Region:
    """Region read from the sensor, in pixels."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True, slots=True)
class CameraSettings:
    """Settings of a camera; ``check`` and ``configure`` answer with the achievable ones.

    Parameters
    ----------
    region
        Region read out.
    exposure_s
        Exposure time in seconds.
    frame_rate_hz
        Frames per second.
    gain_db
        Analogue gain in decibels.
    """

    region: Region
    exposure_s: float
    frame_rate_hz: float
    gain_db: float = 0.0


@dataclass(frozen=True, slots=True)
class CameraInfo:
    """Identity and fixed properties of a camera."""

    model: str
    serial: str
    sensor_shape: tuple[int, int]
    bit_depth: int
    simulated: bool

    @property
    def full_scale(self) -> int:
        """Highest count a pixel can report."""
        return int(2**self.bit_depth - 1)


@dataclass(frozen=True, slots=True)
class FrameStatus:
    """Counters of a camera since ``start``: delivered, lost (gaps of the index), time-outs."""

    delivered: int = 0
    lost: int = 0
    timeouts: int = 0
