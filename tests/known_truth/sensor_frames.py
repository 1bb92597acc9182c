"""Frames of a Shack-Hartmann sensor whose grid is known exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_sim.optics.shack_hartmann import ShackHartmannOptics

WAVELENGTH = 635e-9
SPOT = 2.3
N_PIX = 8


def turbulence(n: int, rms_m: float, seed: int = 1) -> NDArray[np.float32]:
    """Optical path of a random screen ``(n, n)`` in metres."""
    rng = np.random.default_rng(seed)
    f = np.fft.fftfreq(n)
    shape = (f[:, None] ** 2 + f**2 + (1 / (4 * n)) ** 2) ** (-11 / 12)
    opd = np.fft.ifft2(np.fft.fft2(rng.standard_normal((n, n))) * shape).real
    return (opd * rms_m / opd.std()).astype(np.float32)


def pupil_amplitude(n: int, beam: float = np.inf) -> NDArray[np.float32]:
    """Round pupil of ``n`` samples; ``beam`` is the 1/e^2 intensity radius in pupil radii."""
    line = (np.arange(n) - (n - 1) / 2) / (n / 2)
    r2 = line[:, None] ** 2 + line**2
    return np.where(r2 <= 1, np.exp(-r2 / beam**2), 0).astype(np.float32)


def sensor(
    n_sub: int,
    pitch: float,
    offset: tuple[float, float],
    shape: tuple[int, int],
    beam: float = np.inf,
) -> tuple[ShackHartmannOptics, tuple[float, float]]:
    """Optics whose grid lies ``offset`` (x, y) pixels off the middle, and the grid's true origin."""
    half = pitch * (n_sub - 1) / 2
    origin = ((shape[1] - 1) / 2 - half + offset[0], (shape[0] - 1) / 2 - half + offset[1])
    amplitude = pupil_amplitude(n_sub * N_PIX, beam)
    return ShackHartmannOptics(n_sub, N_PIX, WAVELENGTH, pitch, SPOT, origin, shape, amplitude), origin


def flat(optics: ShackHartmannOptics, peak: float = 700.0) -> NDArray[np.float32]:
    """Frame of a flat wavefront with a given peak in counts."""
    image = optics.frame(np.zeros(optics.amplitude.shape, np.float32))
    return np.asarray(image * (peak / image.max()), dtype=np.float32)
