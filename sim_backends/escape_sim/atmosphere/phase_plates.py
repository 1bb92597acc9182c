"""Von Karman phase screens on rotating plates, and the changer that puts one of them into the beam."""

from __future__ import annotations

from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from escape_hw.errors import ConfigError
from escape_sim.atmosphere.von_karman import lit_columns, power_spectrum

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig
    from escape_sim.optics.pupil import PupilGeometry


def von_karman_screen(
    size: int, pixel_m: float, r0_m: float, outer_scale_m: float, rng: np.random.Generator
) -> NDArray[np.float32]:
    """Draw the phase ``(size, size)`` in radians of a periodic screen, with zero mean.

    The screen contains no structure larger than itself, so ``size * pixel_m`` should be several outer
    scales. Other parameters as for :class:`~escape_sim.atmosphere.von_karman.TurbulenceSource`.
    """
    f = np.fft.fftfreq(size, pixel_m)
    f2 = f[:, None] ** 2 + f[None, : size // 2 + 1] ** 2
    psd = power_spectrum(f2, r0_m, outer_scale_m)
    psd[0, 0] = 0.0
    white = np.fft.rfft2(rng.standard_normal((size, size)))
    # White noise has |FFT|^2 = size^2 on average; the screen needs psd / area per frequency cell.
    scale = size / (size * pixel_m)
    return np.asarray(np.fft.irfft2(white * np.sqrt(psd) * scale, s=(size, size)), dtype=np.float32)


@njit(cache=True, fastmath=True, nogil=True)
def _add_screen(screen, scale, x0, y0, ux, uy, first, last, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``scale`` times a bilinearly interpolated periodic screen (power-of-two size) to ``out``.

    Row ``i``, column ``j`` is at ``(x0, y0) + j u + i (-uy, ux)`` on the screen; only columns
    ``first[i]..last[i]`` are written.
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
    """A phase screen on a plate that rotates in front of the pupil.

    The pupil is ``radius_m`` from the axis: the pattern crosses it, rotates on the way and repeats
    after one revolution.

    Parameters
    ----------
    opd_m
        Optical path difference of the plate ``(size, size)`` in metres, size a power of two.
    pixel_m, radius_m
        Pixel size of plate and pupil, and distance of the pupil's centre from the axis, in metres.
    lit
        Samples ``(n, n)`` of the pupil that need values; others are not written.

    Raises
    ------
    ValueError
        The plate is not square with a power-of-two side.
    """

    def __init__(
        self, opd_m: NDArray[np.float32], pixel_m: float, radius_m: float, lit: NDArray[np.bool_]
    ) -> None:
        size = opd_m.shape[0]
        if opd_m.shape != (size, size) or size & (size - 1):
            raise ValueError(f"a plate has {opd_m.shape} pixels; it must be square with a power-of-two side")
        self._opd, self._pixel, self._radius = np.ascontiguousarray(opd_m, np.float32), pixel_m, radius_m
        self._n = lit.shape[0]
        self._first, self._last = lit_columns(lit)

    def add(self, path_m: float, out: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add ``strength`` times the plate's optical path in metres to ``out (n, n)``.

        ``path_m`` is the length of the arc travelled at the pupil's centre in metres.
        """
        angle = path_m / self._radius
        c, s = float(np.cos(angle)), float(np.sin(angle))
        half = (self._n - 1) / 2
        # Plate coordinates of the pupil's first pixel: axis + R(angle) (radius - half, -half).
        px, py = self._radius / self._pixel - half, -half
        centre = self._opd.shape[0] / 2
        _add_screen(
            self._opd, np.float32(strength), centre + c * px - s * py, centre + s * px + c * py, c, s,
            self._first, self._last, out,
        )  # fmt: skip


#: Side of the phase plates in pixels and distance of the pupil from their axis.
_PLATE_PIXELS = 2048
_PLATE_RADIUS_M = 28e-3
#: Plates cached by a process, 16 MB each.
_MAX_CACHED_PLATES = 3


class PhasePlates:
    """Changer of rotating phase plates; adds nothing in a system without plates.

    Each plate has its own stream of ``seed``, so the order of use does not matter. ``number`` is the
    selected plate, ``inserted`` whether it is in the beam.
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
        """Change the speed at time ``now_s``; the plate's position is continuous."""
        self._path, self._speed_set_s, self._speed = self._path_at(now_s), now_s, speed_m_s

    def add(self, time_s: float, opd_m: NDArray[np.float32], strength: float = 1.0) -> None:
        """Add ``strength`` times the optical path at ``time_s`` to ``opd_m (n, n)``, in metres."""
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
    """Optical path of a plate in metres; cached for benches that are opened again."""
    rng = np.random.default_rng(np.random.SeedSequence(entropy, spawn_key=key))
    phase = von_karman_screen(_PLATE_PIXELS, pixel_m, r0_m, outer_scale_m, rng)
    phase *= np.float32(wavelength_m / (2 * np.pi))
    return phase
