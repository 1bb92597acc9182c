"""Axes and travel of the stage, read from the controller and checked against the configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_drivers.pi.controller import E727
from escape_hw.errors import DeviceError

if TYPE_CHECKING:
    from escape_hw.config.devices import StageConfig


@dataclass(frozen=True, slots=True, eq=False)
class AxisTravel:
    """Range and clock of both axes.

    Parameters
    ----------
    lower, upper
        Ends of the travel ``(2,)`` in the controller's unit.
    unit_rad
        Radians per unit.
    servo_s
        Period of the servo in seconds.
    gain
        Beam's tilt per tilt of each axis ``(2,)``.
    """

    lower: NDArray[np.float64]
    upper: NDArray[np.float64]
    unit_rad: float
    servo_s: float
    gain: NDArray[np.float64]

    @property
    def centre(self) -> NDArray[np.float64]:
        """Middle of the travel ``(2,)``."""
        return 0.5 * (self.lower + self.upper)

    @property
    def reach_rad(self) -> float:
        """Tilt of the beam from the centre, in radians of mirror, that both axes can do."""
        return float(np.min((self.upper - self.lower) / 2 * np.abs(self.gain))) * self.unit_rad

    def positions(self, tilt_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """Places of the axes for tilts ``(..., 2)`` of the beam, in radians of mirror."""
        return np.asarray(self.centre + tilt_rad / self.gain / self.unit_rad)

    def tilts(self, positions: NDArray[np.float64]) -> NDArray[np.float64]:
        """Tilts for places; the inverse of :meth:`positions`."""
        return np.asarray((positions - self.centre) * self.unit_rad * self.gain)


def read_travel(name: str, controller: E727, serial: str, stage: StageConfig) -> AxisTravel:
    """Check the controller's identity and read the limits of its axes; moves nothing.

    Raises
    ------
    DeviceError
        Another controller, axes that are not there or carry no stage, or limits that are none.
    """
    want, found = serial, controller.serial
    if want and want != found:
        raise DeviceError(
            name,
            f"found the controller with serial number {found!r}, not {want!r}; correct serial or the address",
        )
    axes = stage.axes
    present = controller.axis_names()
    for axis in axes:
        if axis not in present:
            text = f"has no axis {axis!r}, only {', '.join(present)}"
            raise DeviceError(name, f"{text}; see stage.axes")
    for axis, carried in zip(axes, controller.stage_names(), strict=True):
        if "NOSTAGE" in carried.upper():
            raise DeviceError(name, f"axis {axis} carries no stage; see stage.axes")
    lower, upper = controller.limits()
    if not all(low < high for low, high in zip(lower, upper, strict=True)):
        text = f"reports limits {lower} to {upper}"
        raise DeviceError(name, f"{text}; is the platform's cable plugged in? See TMN? and TMX?")
    unit_rad, servo_s = controller.unit_rad(), controller.servo_period_s()
    return AxisTravel(np.array(lower), np.array(upper), unit_rad, servo_s, np.array(stage.axis_gain))
