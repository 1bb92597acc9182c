"""Random realisations of von Karman turbulence: a periodic screen and the waves too long for it."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from escape_sim.spline import spline_gain

#: Points along each side of a frequency cell at which its power is summed.
_POINTS = 16
#: Frequency cells on either side of zero whose power is summed instead of taken at their centres.
_NEAR = 4
#: Most times that the cell at zero frequency is divided into thirds: waves of 3^20 screens.
_MOST_LEVELS = 20


def power_spectrum(f2: NDArray[np.float64], r0_m: float, outer_scale_m: float) -> NDArray[np.float64]:
    """Power spectral density of the phase in rad^2 m^2.

    ``0.0229 r0^(-5/3) (f^2 + 1 / L0^2)^(-11/6)`` (Roddier 1981), ``f`` in cycles per metre.

    Parameters
    ----------
    f2
        Squares of the frequencies, any shape, in 1 / m^2.
    r0_m, outer_scale_m
        Fried parameter and outer scale in metres.
    """
    return np.asarray(0.0229 * r0_m ** (-5 / 3) * (f2 + outer_scale_m**-2) ** (-11 / 6))


def _cell_power(
    fx: NDArray[np.float64], fy: NDArray[np.float64], width: float, r0_m: float, outer_scale_m: float
) -> NDArray[np.float64]:
    """Power in rad^2 that one wave at a cell's centre must have to tilt a pupil as the cell does.

    A wave much longer than the pupil is seen through its slope, so what must be right is the sum of
    ``power x f^2`` over the cell.
    """
    inside = ((np.arange(_POINTS) + 0.5) / _POINTS - 0.5) * width
    u = fx[..., None, None] + inside
    v = fy[..., None, None] + inside[:, None]
    f2 = u**2 + v**2
    slope = (power_spectrum(f2, r0_m, outer_scale_m) * f2).mean(axis=(-2, -1)) * width**2
    return np.asarray(slope / (fx**2 + fy**2))


@dataclass(frozen=True, slots=True, eq=False)
class Realisation:
    """One draw of a turbulent layer.

    Parameters
    ----------
    coefficients
        Cubic B-spline coefficients of the periodic screen ``(size, size + margin)`` in radians; the
        first ``margin`` columns come again at the end, so that a pupil never has to wrap around.
    waves
        Complex amplitudes ``(n_waves,)`` in radians of the waves longer than the screen, see
        :attr:`TurbulenceSource.wave_frequencies`.
    """

    coefficients: NDArray[np.float32]
    waves: NDArray[np.complex128]


class TurbulenceSource:
    """Draws independent realisations of one kind of turbulence.

    Parameters
    ----------
    size
        Pixels across the periodic screen, a power of two.
    pixel_m
        Pixel size in metres.
    r0_m, outer_scale_m
        Fried parameter, at the wavelength that the phase shall refer to, and outer scale in metres.
    margin
        Columns repeated at the end of each screen.

    Attributes
    ----------
    wave_frequencies
        ``(n_waves, 2)`` as (fx, fy) in cycles per metre: the cell of zero frequency, which the screen
        cannot hold, divided into thirds (Lane, Glindemann and Dainty 1992) until four outer scales
        fit into a wave; there are none when the screen itself is four outer scales wide.
    """

    def __init__(self, size: int, pixel_m: float, r0_m: float, outer_scale_m: float, margin: int) -> None:
        if size & (size - 1) or size < 2 * margin:
            raise ValueError(
                f"a screen of {size} pixels is not a power of two with room for a pupil of {margin} pixels"
            )
        self.size, self.pixel_m, self.margin = size, pixel_m, margin
        self._amplitude = self._spectral_amplitude(r0_m, outer_scale_m)
        step = 1 / (size * pixel_m)
        levels = min(max(math.ceil(math.log(4 * outer_scale_m * step, 3)), 0), _MOST_LEVELS)
        # Half of the eight outer thirds; the other half are their complex conjugates.
        half = np.array([[1, 0], [-1, 1], [0, 1], [1, 1]], dtype=float)
        widths = step / 3.0 ** np.arange(1, levels + 1)
        self.wave_frequencies = (half[None] * widths[:, None, None]).reshape(-1, 2)
        self._wave_rms = np.sqrt(
            np.concatenate(
                [_cell_power(half[:, 0] * w, half[:, 1] * w, w, r0_m, outer_scale_m) for w in widths]
            )
            if levels
            else np.empty(0)
        )

    def draw(self, rng: np.random.Generator) -> Realisation:
        """One realisation, independent of every other drawn from an independent generator."""
        size = self.size
        parts = rng.standard_normal((size, size // 2 + 1, 2), dtype=np.float32)
        spectrum = parts.view(np.complex64)[..., 0]
        spectrum *= self._amplitude
        screen = fft.irfft2(spectrum, s=(size, size), norm="forward", workers=1, overwrite_x=True)
        coefficients = np.concatenate([screen, screen[:, : self.margin]], axis=1)
        pairs = rng.standard_normal((len(self._wave_rms), 2))
        # A real wave is twice the real part of its complex amplitude.
        waves = 2 * self._wave_rms * (pairs[:, 0] + 1j * pairs[:, 1]) / math.sqrt(2)
        return Realisation(np.asarray(coefficients, np.float32), waves)

    def _spectral_amplitude(self, r0_m: float, outer_scale_m: float) -> NDArray[np.float32]:
        """Rms of the real and of the imaginary part of each Fourier component ``(size, size / 2 + 1)``."""
        size, step = self.size, 1 / (self.size * self.pixel_m)
        fx = np.arange(size // 2 + 1) * step
        fy = np.asarray(fft.fftfreq(size, self.pixel_m), dtype=np.float64)
        power = power_spectrum(fx**2 + fy[:, None] ** 2, r0_m, outer_scale_m) * step**2
        rows = np.r_[0 : _NEAR + 1, -_NEAR:0]
        u, v = np.meshgrid(fx[: _NEAR + 1], fy[rows])
        u[0, 0] = step  # any place but zero, whose power is taken off below
        power[rows, : _NEAR + 1] = _cell_power(u, v, step, r0_m, outer_scale_m)
        power[0, 0] = 0.0
        # Where a column is its own mirror image, the transform keeps half of what it is given.
        power[:, [0, -1]] *= 2
        gain_x, gain_y = spline_gain(fx * self.pixel_m), spline_gain(fy * self.pixel_m)
        return np.asarray(np.sqrt(power / 2) * np.outer(gain_y, gain_x), dtype=np.float32)
