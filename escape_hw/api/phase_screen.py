"""Interface of rotating phase screens, the turbulence of a bench."""

from __future__ import annotations

import abc
import math
from dataclasses import dataclass
from typing import final

import numpy as np

from escape_hw.api.device import Device
from escape_hw.errors import SettingRejected


@dataclass(frozen=True, slots=True)
class ScreenState:
    """State of a phase screen: number from 0, whether it is in the beam, speed across the pupil (0: stopped).

    ``blocked`` is true while a beam stop is inserted, for dark frames.
    """

    screen: int
    inserted: bool
    speed_m_s: float
    blocked: bool = False


@dataclass(frozen=True, slots=True)
class ScreenInfo:
    """Identity of a changer of phase screens: model, serial number, whether it is a twin."""

    model: str
    serial: str
    simulated: bool


class PhaseScreen(Device):
    """A changer with one or more rotating phase screens.

    Without a screen in the beam the bench has a calibration source, which push-pull uses. A telescope has
    no such device, and open-loop DO-CRIME and ESCAPE do not use it.
    """

    @property
    @abc.abstractmethod
    def info(self) -> ScreenInfo:
        """Identity; available once open."""

    @property
    @abc.abstractmethod
    def state(self) -> ScreenState:
        """The present state."""

    @property
    @abc.abstractmethod
    def n_screens(self) -> int:
        """Number of screens."""

    @final
    def set(
        self,
        *,
        screen: int | None = None,
        inserted: bool | None = None,
        speed_m_s: float | None = None,
        blocked: bool | None = None,
    ) -> ScreenState:
        """Change the given values, see :class:`ScreenState`, and keep the others; returns the state reached.

        Raises
        ------
        SettingRejected
            A value is out of range; nothing is changed.
        """
        self.require_open()
        with self._driver_calls:
            now, n_screens = self._require_kind(self.state, ScreenState, "its state"), self.n_screens
        want = ScreenState(
            now.screen if screen is None else screen,
            now.inserted if inserted is None else inserted,
            now.speed_m_s if speed_m_s is None else speed_m_s,
            now.blocked if blocked is None else blocked,
        )
        if isinstance(want.screen, bool) or not isinstance(want.screen, int | np.integer):
            raise SettingRejected(self.name, f"screen is {want.screen!r}; it must be a whole number")
        for name, value in (("inserted", want.inserted), ("blocked", want.blocked)):
            if not isinstance(value, bool | np.bool_):
                raise SettingRejected(self.name, f"{name} is {value!r}; it must be true or false")
        if not 0 <= want.screen < n_screens:
            raise SettingRejected(self.name, f"screen {want.screen} is not one of 0..{n_screens - 1}")
        if not 0 <= want.speed_m_s < math.inf:
            raise SettingRejected(
                self.name, f"speed_m_s is {want.speed_m_s}; it must be finite and not negative"
            )
        with self._driver_calls:
            self._set(want)
            return self._require_kind(self.state, ScreenState, "its state")

    def _after_open(self) -> None:
        self._require_kind(self.info, ScreenInfo, "info")
        self._require_kind(self.n_screens, int, "n_screens")

    @abc.abstractmethod
    def _set(self, want: ScreenState) -> None:
        """Apply a checked state."""
