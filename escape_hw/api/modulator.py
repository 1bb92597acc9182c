"""Interface of tip-tilt modulators for pyramid sensors."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass, field
from typing import Any, final

from escape_hw.api.device import Device
from escape_hw.errors import DeviceError, SettingRejected


@dataclass(frozen=True, slots=True)
class Modulation:
    """Circular modulation: radius and centre in radians of mirror tilt, frequency in hertz."""

    radius_rad: float
    frequency_hz: float
    centre_rad: tuple[float, float] = (0.0, 0.0)


@dataclass(frozen=True, slots=True)
class ModulatorInfo:
    """Identity of a modulator: model, serial number, largest tilt from the centre in radians."""

    model: str
    serial: str
    max_tilt_rad: float
    simulated: bool


@dataclass(frozen=True, slots=True)
class ModulatorStatus:
    """Present status of a modulator.

    Parameters
    ----------
    info
        Identity of the modulator.
    modulation
        The modulation in force; ``None`` when parked.
    position_rad
        Tilt (x, y) from the centre in radians, if the stage reports it.
    details
        Further values reported by the stage (servos, connection, corrections), plain values.
    """

    info: ModulatorInfo
    modulation: Modulation | None
    position_rad: tuple[float, float] | None = None
    details: dict[str, Any] = field(default_factory=dict)


class TipTiltModulator(Device):
    """A tip-tilt stage that moves the beam in a circle; when stopped or closed it parks at its centre.

    Drivers implement ``_open``, ``_close``, ``_check``, ``_modulate``, ``_park``, ``info`` and
    ``modulation``, and optionally ``_status``, ``_status_when_closed`` and ``_release``.
    """

    @property
    @abc.abstractmethod
    def info(self) -> ModulatorInfo:
        """Identity and fixed properties; available once open."""

    @property
    @abc.abstractmethod
    def modulation(self) -> Modulation | None:
        """The modulation in force, as read back from the stage; ``None`` when parked."""

    @final
    def check(self, want: Modulation) -> Modulation:
        """Nearest achievable modulation (the clock quantises the frequency). Changes nothing.

        Raises
        ------
        SettingRejected
            The modulation is outside the range of the stage; the message gives the range.
        """
        self.require_open()
        if not (0 <= want.radius_rad < math.inf and 0 < want.frequency_hz < math.inf):
            raise SettingRejected(
                self.name, f"{want}: radius must be >= 0 and frequency positive, both finite"
            )
        if not all(map(math.isfinite, want.centre_rad)):
            raise SettingRejected(self.name, f"{want}: the centre must be finite")
        largest_tilt = want.radius_rad + math.hypot(*want.centre_rad)
        if largest_tilt > self.info.max_tilt_rad:
            raise SettingRejected(
                self.name,
                f"{want}: tilts by {largest_tilt:.4g} rad; the range is 0 to {self.info.max_tilt_rad:g} rad",
            )
        with self._driver_calls:
            return self._require_kind(self._check(want), Modulation, "its achievable modulation")

    @final
    def modulate(self, want: Modulation) -> Modulation:
        """Start modulating, or change the modulation; returns the modulation read back from the stage.

        Raises
        ------
        SettingRejected
            See :meth:`check`; the stage is unchanged.
        DeviceError
            The stage did not start.
        """
        achievable = self.check(want)
        with self._driver_calls:
            self._modulate(achievable)
            achieved = self.modulation
        if achieved is None:
            raise DeviceError(self.name, f"does not move after the start of {achievable}")
        return self._require_kind(achieved, Modulation, "its modulation")

    @final
    def park(self) -> None:
        """Stop modulating and go to the centre; may be repeated."""
        self.require_open()
        with self._driver_calls:
            self._park()

    @final
    def status(self) -> ModulatorStatus:
        """Present status. Moves nothing; a closed stage is connected for the query."""
        with self._lock, self._driver_calls:
            status = self._status() if self.is_open else self._status_when_closed()
            return self._require_kind(status, ModulatorStatus, "its status")

    @final
    def release(self) -> bool:
        """Disconnect without parking, for aligning the beam; the controller keeps modulating.

        Returns false if the stage cannot keep modulating and was closed as usual.
        """
        with self._lock:
            self.require_open()
            with self._driver_calls:
                released = self._release()
            if not released:
                self.close()
                return False
            self._is_open = False
            return True

    def _after_open(self) -> None:
        self._require_kind(self.info, ModulatorInfo, "info")

    def _before_close(self) -> None:
        self._park()

    def _status(self) -> ModulatorStatus:
        """Status of an open stage."""
        return ModulatorStatus(self.info, self.modulation)

    def _status_when_closed(self) -> ModulatorStatus:
        """Status of a stage that is not open."""
        with self:
            return self._status()

    def _release(self) -> bool:
        """Disconnect while the stage keeps modulating; false if that is impossible."""
        return False

    @abc.abstractmethod
    def _check(self, want: Modulation) -> Modulation:
        """Nearest achievable modulation, or raise :class:`SettingRejected`."""

    @abc.abstractmethod
    def _modulate(self, modulation: Modulation) -> None:
        """Start a modulation returned by ``_check``."""

    @abc.abstractmethod
    def _park(self) -> None:
        """Stop and go to the centre."""
