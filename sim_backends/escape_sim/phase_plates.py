"""The bench's turbulence: one of several rotating phase plates, in the beam or out of it."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import ConfigError
from escape_sim.geometry import PupilGeometry
from escape_sim.screen import RotatingScreen, von_karman_screen

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Side of the phase plates in pixels and distance of the pupil from their axis.
_PLATE_PIXELS = 2048
_PLATE_RADIUS_M = 28e-3
#: Plates kept by a process, 16 MB each.
_PLATES_KEPT = 3


class PhasePlates:
    """A changer of rotating phase plates; a system without one has still air.

    Parameters
    ----------
    config
        Gives the plates (``devices.screen``).
    pupil
        The sampled pupil.
    seed
        Each plate has a key of its own, so that the order of use does not matter.

    Attributes
    ----------
    number, inserted
        Which plate, and whether it is in the beam.
    """

    def __init__(self, config: SystemConfig, pupil: PupilGeometry, seed: np.random.SeedSequence) -> None:
        screen = config.devices.screen
        self._config, self._pupil, self._seed = config, pupil, seed
        self._plates: dict[int, RotatingScreen] = {}
        self.number = screen.screen if screen else 0
        self.inserted = screen is not None
        self._path, self._since = 0.0, 0.0
        self._speed = screen.speed_m_s if screen else 0.0

    @property
    def speed_m_s(self) -> float:
        """Speed of the plate across the pupil in metres per second."""
        return self._speed

    def set_speed(self, speed_m_s: float, now_s: float) -> None:
        """Turn at another speed from now on."""
        self._path, self._since, self._speed = self._path_at(now_s), now_s, speed_m_s

    def add(self, time_s: float, opd_m: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add the optical path of a moment, times ``strength``, to ``opd_m (n, n)`` in metres."""
        if self.inserted:
            self._plate().add(self._path_at(time_s), opd_m, strength)

    def _path_at(self, time_s: float) -> float:
        return self._path + self._speed * (time_s - self._since)

    def _plate(self) -> RotatingScreen:
        if self.number not in self._plates:
            screen = self._config.devices.screen
            if screen is None:
                raise ConfigError(f"system {self._config.system.name!r} has no [devices.screen] section")
            pixel = self._pupil.pixel_m
            opd = _engraved(
                self._seed.entropy, (*self._seed.spawn_key, self.number), pixel,
                screen.screens_r0_m[self.number], screen.outer_scale_m, self._config.system.wavelength_m,
            )  # fmt: skip
            self._plates[self.number] = RotatingScreen(opd, pixel, _PLATE_RADIUS_M, self._pupil.lit)
        return self._plates[self.number]


@lru_cache(maxsize=_PLATES_KEPT)
def _engraved(
    entropy: Any, key: tuple[int, ...], pixel_m: float, r0_m: float, outer_scale_m: float, wavelength_m: float
) -> NDArray[np.float32]:
    """The optical path of a plate in metres; who opens the same bench again need not draw it again."""
    rng = np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=key))
    phase = von_karman_screen(_PLATE_PIXELS, pixel_m, r0_m, outer_scale_m, rng)
    phase *= np.float32(wavelength_m / (2 * np.pi))
    return phase
