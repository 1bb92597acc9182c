"""Von Karman phase screens on rotating plates, and the changer of a bench that puts one of them into the beam."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.errors import ConfigError
from escape_sim.optics.pupil import PupilGeometry

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig


def von_karman_screen(
    size: int, pixel_m: float, r0_m: float, outer_scale_m: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """A periodic screen of von Karman turbulence.

    The power spectrum of the phase is ``0.0229 r0^(-5/3) (f^2 + 1/L0^2)^(-11/6)`` in rad^2 m^2
    (Roddier 1981; f in cycles per metre).

    Parameters
    ----------
    size
        Pixels across; make ``size * pixel_m`` several outer scales, for the screen holds no
        structure larger than itself.
    pixel_m
        Pixel size in metres.
    r0_m
        Fried parameter in metres at the wavelength that the phase refers to.
    outer_scale_m
        Outer scale in metres.

    Returns
    -------
    ndarray of float32, ``(size, size)``
        Phase in radians with zero mean.
    """
    f = np.fft.fftfreq(size, pixel_m)
    f2 = f[:, None] ** 2 + f[None, : size // 2 + 1] ** 2
    psd = 0.0229 * r0_m ** (-5 / 3) * (f2 + outer_scale_m**-2) ** (-11 / 6)
    psd[0, 0] = 0.0
    white = np.fft.rfft2(rng.standard_normal((size, size)))
    # White noise has |FFT|^2 = size^2 on average; the screen needs psd / area per frequency cell.
    scale = size / (size * pixel_m)
    return np.asarray(np.fft.irfft2(white * np.sqrt(psd) * scale, s=(size, size)), dtype=np.float32)


@njit(cache=True, fastmath=True, nogil=True)
def _add_screen(screen, scale, x0, y0, ux, uy, first, last, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``scale`` times the bilinear reading of a periodic screen (power-of-two size) to ``out``.

    Row ``i``, column ``j`` reads at ``(x0, y0) + j u + i (-uy, ux)``; only columns
    ``first[i]..last[i]`` are touched.
    """
    mask = screen.shape[0] - 1
    for i in range(out.shape[0]):
        for j in range(first[i], last[i]):
            x = x0 + j * ux - i * uy
            y = y0 + j * uy + i * ux
            fx = np.floor(x)
            fy = np.floor(y)
            wx = np.float32(x - fx)
            wy = np.float32(y - fy)
            a = int(fx) & mask
            b = int(fy) & mask
            a1 = (a + 1) & mask
            b1 = (b + 1) & mask
            top = screen[b, a] + wx * (screen[b, a1] - screen[b, a])
            low = screen[b1, a] + wx * (screen[b1, a1] - screen[b1, a])
            out[i, j] += scale * (top + wy * (low - top))


class RotatingScreen:
    """A plate with a phase screen that turns in front of the pupil.

    The pupil sits ``radius_m`` from the axis, so the pattern crosses it at the asked speed, turns
    as it goes, and repeats after one revolution, as on the bench.

    Parameters
    ----------
    opd_m
        Optical path difference of the plate ``(size, size)`` in metres, size a power of two.
    pixel_m
        Pixel size of plate and pupil in metres.
    radius_m
        Distance of the pupil's centre from the axis in metres.
    lit
        Where the pupil needs values ``(n, n)``; other pixels are left alone.
    """

    def __init__(
        self, opd_m: NDArray[np.float32], pixel_m: float, radius_m: float, lit: NDArray[np.bool_]
    ) -> None:
        size = opd_m.shape[0]
        if opd_m.shape != (size, size) or size & (size - 1):
            raise ValueError(f"a plate of {opd_m.shape} pixels is not a square with a power-of-two side")
        self._opd, self._pixel, self._radius = np.ascontiguousarray(opd_m, np.float32), pixel_m, radius_m
        self._n = lit.shape[0]
        self._first = np.where(lit.any(axis=1), lit.argmax(axis=1), 0)
        self._last = np.where(lit.any(axis=1), lit.shape[1] - lit[:, ::-1].argmax(axis=1), 0)

    def add(self, path_m: float, out: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add the plate's optical path in metres to ``out (n, n)``.

        Parameters
        ----------
        path_m
            Length of the arc travelled at the pupil's centre in metres.
        strength
            Factor on it.
        """
        angle = path_m / self._radius
        c, s = float(np.cos(angle)), float(np.sin(angle))
        half = (self._n - 1) / 2
        # Plate coordinates of the pupil's first pixel: axis + R(angle) (radius - half, -half).
        px, py = self._radius / self._pixel - half, -half
        middle = self._opd.shape[0] / 2
        _add_screen(
            self._opd, np.float32(strength), middle + c * px - s * py, middle + s * px + c * py, c, s,
            self._first, self._last, out,
        )  # fmt: skip


#: Side of the phase plates in pixels and distance of the pupil from their axis.
_PLATE_PIXELS = 2048
_PLATE_RADIUS_M = 28e-3
#: Plates kept by a process, 16 MB each.
_MAX_CACHED_PLATES = 3


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
        self._path, self._speed_set_s = 0.0, 0.0
        self._speed = screen.speed_m_s if screen else 0.0

    @property
    def speed_m_s(self) -> float:
        """Speed of the plate across the pupil in metres per second."""
        return self._speed

    def set_speed(self, speed_m_s: float, now_s: float) -> None:
        """Turn at another speed from now on."""
        self._path, self._speed_set_s, self._speed = self._path_at(now_s), now_s, speed_m_s

    def add(self, time_s: float, opd_m: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add the optical path of a moment, times ``strength``, to ``opd_m (n, n)`` in metres."""
        if self.inserted:
            self._plate().add(self._path_at(time_s), opd_m, strength)

    def _path_at(self, time_s: float) -> float:
        return self._path + self._speed * (time_s - self._speed_set_s)

    def _plate(self) -> RotatingScreen:
        if self.number not in self._plates:
            screen = self._config.devices.screen
            if screen is None:
                raise ConfigError(f"system {self._config.system.name!r} has no [devices.screen] section")
            pixel = self._pupil.pixel_m
            opd = _plate_opd(
                self._seed.entropy, (*self._seed.spawn_key, self.number), pixel,
                screen.screens_r0_m[self.number], screen.outer_scale_m, self._config.system.wavelength_m,
            )  # fmt: skip
            self._plates[self.number] = RotatingScreen(opd, pixel, _PLATE_RADIUS_M, self._pupil.lit)
        return self._plates[self.number]


@lru_cache(maxsize=_MAX_CACHED_PLATES)
def _plate_opd(
    entropy: Any, key: tuple[int, ...], pixel_m: float, r0_m: float, outer_scale_m: float, wavelength_m: float
) -> NDArray[np.float32]:
    """The optical path of a plate in metres; who opens the same bench again need not draw it again."""
    rng = np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=key))
    phase = von_karman_screen(_PLATE_PIXELS, pixel_m, r0_m, outer_scale_m, rng)
    phase *= np.float32(wavelength_m / (2 * np.pi))
    return phase
