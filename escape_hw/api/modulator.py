"""Tip-tilt modulators for pyramid sensors."""

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
    """What a modulator does at a moment.

    Parameters
    ----------
    info
        Which modulator.
    modulation
        The modulation in force; ``None``: it does not turn.
    position_rad
        Where it points (x, y) from its centre, where it can tell.
    details
        What else this stage tells of itself (servos, connection, corrections), plain values.
    """

    info: ModulatorInfo
    modulation: Modulation | None
    position_rad: tuple[float, float] | None = None
    details: dict[str, Any] = field(default_factory=dict)


class TipTiltModulator(Device):
    """A tip-tilt stage that turns the beam in a circle; parks at its centre when stopped.

    Drivers fill in ``_open``, ``_close``, ``_check``, ``_modulate``, ``_park``,
    ``info`` and ``modulation``; where they can, ``_status``, ``_status_when_closed`` and ``_release`` too. Closing
    parks first.
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
        """The nearest modulation the stage can do (its clock quantises the frequency); changes nothing.

        Raises
        ------
        SettingRejected
            Nothing near ``want`` is possible; the message gives the allowed range.
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
                f"{want}: tilts by {largest_tilt:.4g} rad; it does 0 to {self.info.max_tilt_rad:g} rad",
            )
        return self._check(want)

    @final
    def modulate(self, want: Modulation) -> Modulation:
        """Start modulating, or change the modulation.

        Returns
        -------
        Modulation
            What the stage really does, never what was asked.

        Raises
        ------
        SettingRejected
            See :meth:`check`; the stage goes on as it was.
        DeviceError
            The stage did not start.
        """
        achievable = self.check(want)
        self._modulate(achievable)
        achieved = self.modulation
        if achieved is None:
            raise DeviceError(self.name, f"does not move although it was told to do {achievable}")
        return achieved

    @final
    def park(self) -> None:
        """Stop modulating and go to the centre; may be repeated."""
        self.require_open()
        self._park()

    @final
    def status(self) -> ModulatorStatus:
        """What the stage does now. Moves nothing; one that is not open is connected for the question.

        Raises
        ------
        DeviceError
            It cannot be asked.
        """
        with self._lock:
            return self._status() if self.is_open else self._status_when_closed()

    @final
    def release(self) -> bool:
        """Disconnect without parking: a stage with a clock of its own goes on turning.

        Everything else parks on closing; this is for a person who adjusts the beam.

        Returns
        -------
        bool
            True when the stage goes on; false when it cannot, and was closed as usual.
        """
        with self._lock:
            self.require_open()
            if not self._release():
                self.close()
                return False
            self._is_open = False
            return True

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
        """Disconnect and leave the stage turning; false where that is impossible."""
        return False

    @abc.abstractmethod
    def _check(self, want: Modulation) -> Modulation:
        """Nearest achievable modulation, or raise :class:`SettingRejected`."""

    @abc.abstractmethod
    def _modulate(self, modulation: Modulation) -> None:
        """Start a modulation that came from ``_check``."""

    @abc.abstractmethod
    def _park(self) -> None:
        """Stop and centre."""
