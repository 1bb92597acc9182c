"""Tip-tilt modulators for pyramid sensors."""

from __future__ import annotations

import abc
from dataclasses import dataclass
from typing import final

from escape_hw.api.device import Device
from escape_hw.errors import SettingRejected


@dataclass(frozen=True, slots=True)
class Modulation:
    """Circular modulation: radius and centre in radians of mirror tilt, frequency in hertz."""

    radius_rad: float
    frequency_hz: float
    centre_rad: tuple[float, float] = (0.0, 0.0)


class TipTiltModulator(Device):
    """A tip-tilt stage that turns the beam in a circle; parks at its centre when stopped."""

    @final
    def check(self, want: Modulation) -> Modulation:
        """The nearest modulation the stage can do (its clock quantises the frequency)."""
        self.require_open()
        if want.radius_rad < 0 or not want.frequency_hz > 0:
            raise SettingRejected(self.name, f"{want}: radius must be >= 0 and frequency positive")
        return self._check(want)

    @final
    def modulate(self, want: Modulation) -> Modulation:
        """Start modulating; returns what the stage really does."""
        achievable = self.check(want)
        self._modulate(achievable)
        return achievable

    @final
    def park(self) -> None:
        """Stop modulating and go to the centre."""
        self.require_open()
        self._park()

    def _before_close(self) -> None:
        self._park()

    @abc.abstractmethod
    def _check(self, want: Modulation) -> Modulation:
        """Nearest achievable modulation, or raise :class:`SettingRejected`."""

    @abc.abstractmethod
    def _modulate(self, modulation: Modulation) -> None:
        """Start a modulation that came from ``_check``."""

    @abc.abstractmethod
    def _park(self) -> None:
        """Stop and centre."""
