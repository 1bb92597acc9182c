"""Von Karman turbulence: structure function, power spectrum, random realisations and their interpolation.

A realisation is a periodic screen and the waves that are longer than it. Screens are interpolated by
cubic B-splines.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import fft
from scipy.special import gamma, kv


def structure_function(
    distance_m: NDArray[np.float64], r0_m: float, outer_scale_m: float = np.inf
) -> NDArray[np.float64]:
    """Structure function of the phase in rad^2.

    Kolmogorov's ``6.88 (r / r0)^(5/3)`` for an infinite outer scale, otherwise von Kármán's (Conan 2000,
    thesis, eq. 1.28), which tends to Kolmogorov's at small distances.

    Parameters
    ----------
    distance_m
        Distances in metres, any shape.
    r0_m, outer_scale_m
        Fried parameter at the wavelength of the phase, and outer scale, in metres.
    """
    r = np.abs(np.asarray(distance_m, dtype=float))
    constant = (24 / 5 * gamma(6 / 5)) ** (5 / 6)
    if np.isinf(outer_scale_m):
        return np.asarray(2 * constant * (r / r0_m) ** (5 / 3))
    x = np.maximum(2 * np.pi * r / outer_scale_m, 1e-9)
    scale = 2 ** (1 / 6) * gamma(11 / 6) / np.pi ** (8 / 3) * constant * (outer_scale_m / r0_m) ** (5 / 3)
    # Rounding may make the difference of the two terms negative at small distances.
    return np.where(
        r > 0, scale * np.maximum(gamma(5 / 6) / 2 ** (1 / 6) - x ** (5 / 6) * kv(5 / 6, x), 0), 0.0
    )


#: Positions between two pixels over which the power of interpolated values is averaged.
_N_POSITIONS = 64


def spline_weights(shift: NDArray[np.float64]) -> NDArray[np.float64]:
    """B-spline weights ``(..., 4)`` of the coefficients at -1, 0, 1, 2 for a shift ``0 <= shift < 1``."""
    w = np.asarray(shift)[..., None]
    return np.concatenate(
        [(1 - w) ** 3 / 6, (3 * w**3 - 6 * w**2 + 4) / 6, (1 + 3 * w + 3 * w**2 - 3 * w**3) / 6, w**3 / 6],
        axis=-1,
    )


def spline_gain(frequency: NDArray[np.floating]) -> NDArray[np.float64]:
    """Gain of a Fourier component of the coefficients that preserves the power of interpolated values.

    A spline through given values loses power between the pixels, up to all of it at the highest
    frequency. The gain makes the power right in the mean over all positions, which is what a drifting
    screen shows. Without it a spline loses 3 % of the power at half the highest frequency (linear
    interpolation a third) and half of it at the highest. ``frequency`` is in cycles per pixel.
    """
    position = (np.arange(_N_POSITIONS) + 0.5) / _N_POSITIONS
    weights = spline_weights(position)
    phasors = np.exp(2j * np.pi * np.asarray(frequency)[..., None] * np.arange(-1, 3))
    response = np.einsum("...k,pk->...p", phasors, weights)
    return np.asarray(1 / np.sqrt(np.mean(np.abs(response) ** 2, axis=-1)))


def lit_columns(lit: NDArray[np.bool_]) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """First lit column and the one after the last ``(n,)`` of each row of a pupil; 0, 0 for dark rows."""
    any_lit = lit.any(axis=1)
    first = np.where(any_lit, lit.argmax(axis=1), 0)
    return first, np.where(any_lit, lit.shape[1] - lit[:, ::-1].argmax(axis=1), 0)


@njit(cache=True, fastmath=True, nogil=True)
def add_two_screens(one, two, factors, column, row, weights_x, weights_y, first, last, line, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Add ``factors[0]`` times the interpolated ``one`` and ``factors[1]`` times ``two`` to ``out``.

    ``column`` and ``row`` are the screens' pixels to the left of and above the first sample;
    ``weights_x`` and ``weights_y`` are the four spline weights, the same for the whole pupil. Only
    columns ``first[i]..last[i]`` are written; ``line`` is a work array.
    """
    mask = one.shape[0] - 1
    s, t = factors[0], factors[1]
    a0, a1, a2, a3 = s * weights_y[0], s * weights_y[1], s * weights_y[2], s * weights_y[3]
    b0, b1, b2, b3 = t * weights_y[0], t * weights_y[1], t * weights_y[2], t * weights_y[3]
    x0, x1, x2, x3 = weights_x[0], weights_x[1], weights_x[2], weights_x[3]
    for i in range(out.shape[0]):
        begin, end = first[i], last[i]
        if end <= begin:
            continue
        r0, r1 = (row + i - 1) & mask, (row + i) & mask
        r2, r3 = (row + i + 1) & mask, (row + i + 2) & mask
        start = (column - 1 + begin) & mask
        width = end - begin
        # Slices, because an index that could be negative prevents vectorisation of the loop.
        stop = start + width + 3
        p0, p1, p2, p3 = one[r0, start:stop], one[r1, start:stop], one[r2, start:stop], one[r3, start:stop]
        q0, q1, q2, q3 = two[r0, start:stop], two[r1, start:stop], two[r2, start:stop], two[r3, start:stop]
        target = out[i, begin:end]
        for j in range(width + 3):
            line[j] = a0 * p0[j] + a1 * p1[j] + a2 * p2[j] + a3 * p3[j]
        # A second loop, because a loop over all eight arrays is not vectorised either.
        for j in range(width + 3):
            line[j] += b0 * q0[j] + b1 * q1[j] + b2 * q2[j] + b3 * q3[j]
        for j in range(width):
            target[j] += x0 * line[j] + x1 * line[j + 1] + x2 * line[j + 2] + x3 * line[j + 3]


#: Points along each side of a frequency cell at which its power is summed.
_POINTS_PER_SIDE = 16
#: Frequency cells on either side of zero whose power is summed instead of taken at their centres.
_N_INTEGRATED_CELLS = 4
#: Most divisions of the cell at zero frequency into thirds: waves as long as 3^20 screens.
_MAX_LEVELS = 20


def power_spectrum(f2: NDArray[np.float64], r0_m: float, outer_scale_m: float) -> NDArray[np.float64]:
    """Power spectral density of the phase in rad^2 m^2 for squared frequencies ``f2`` in m^-2.

    ``0.0229 r0^(-5/3) (f^2 + 1 / L0^2)^(-11/6)`` (Roddier 1981), ``f`` in cycles per metre.
    """
    return np.asarray(0.0229 * r0_m ** (-5 / 3) * (f2 + outer_scale_m**-2) ** (-11 / 6))


def _cell_power(
    fx: NDArray[np.float64], fy: NDArray[np.float64], width: float, r0_m: float, outer_scale_m: float
) -> NDArray[np.float64]:
    """Power in rad^2 of one wave at a cell's centre that tilts a pupil as much as the whole cell.

    Waves much longer than the pupil act through their slope, so the sum of ``power x f^2`` over the
    cell is preserved.
    """
    inside = ((np.arange(_POINTS_PER_SIDE) + 0.5) / _POINTS_PER_SIDE - 0.5) * width
    u = fx[..., None, None] + inside
    v = fy[..., None, None] + inside[:, None]
    f2 = u**2 + v**2
    slope = (power_spectrum(f2, r0_m, outer_scale_m) * f2).mean(axis=(-2, -1)) * width**2
    return np.asarray(slope / (fx**2 + fy**2))


@dataclass(frozen=True, slots=True, eq=False)
class TurbulenceRealisation:
    """One realisation of a turbulent layer."""

    #: Cubic B-spline coefficients of the periodic screen ``(size, size + margin)`` in radians. The first
    #: ``margin`` columns are repeated at the end, so that a pupil never wraps around.
    coefficients: NDArray[np.float32]
    #: Complex amplitudes ``(n_waves,)`` in radians of the waves longer than the screen.
    waves: NDArray[np.complex128]


class TurbulenceSource:
    """Draws independent realisations of turbulence.

    Parameters
    ----------
    size, pixel_m
        Pixels across the periodic screen, a power of two, and their size in metres.
    r0_m, outer_scale_m
        Fried parameter, at the wavelength of the phase, and outer scale in metres.
    margin
        Columns repeated at the end of each screen.

    Attributes
    ----------
    wave_frequencies
        ``(n_waves, 2)`` as (fx, fy) in cycles per metre: the cell of zero frequency, which the screen
        cannot contain, divided into thirds (Lane, Glindemann and Dainty 1992) until a wave is four
        outer scales long. Empty if the screen is that large itself.

    Raises
    ------
    ValueError
        ``size`` is not a power of two or is smaller than twice the margin.
    """

    def __init__(self, size: int, pixel_m: float, r0_m: float, outer_scale_m: float, margin: int) -> None:
        if size & (size - 1) or size < 2 * margin:
            raise ValueError(
                f"a screen has {size} pixels across; it must be a power of two and at least {2 * margin}"
            )
        self.size, self.pixel_m, self.margin = size, pixel_m, margin
        self._amplitude = self._spectral_amplitude(r0_m, outer_scale_m)
        step = 1 / (size * pixel_m)
        levels = min(max(math.ceil(math.log(4 * outer_scale_m * step, 3)), 0), _MAX_LEVELS)
        # Half of the eight outer thirds; the other four are their complex conjugates.
        half = np.array([[1, 0], [-1, 1], [0, 1], [1, 1]], dtype=float)
        widths = step / 3.0 ** np.arange(1, levels + 1)
        self.wave_frequencies = (half[None] * widths[:, None, None]).reshape(-1, 2)
        power = [_cell_power(half[:, 0] * w, half[:, 1] * w, w, r0_m, outer_scale_m) for w in widths]
        self._wave_rms = np.sqrt(np.concatenate([np.empty(0), *power]))

    def draw(self, rng: np.random.Generator) -> TurbulenceRealisation:
        """Draw a realisation: first the screen, then the long waves."""
        size = self.size
        parts = rng.standard_normal((size, size // 2 + 1, 2), dtype=np.float32)
        spectrum = parts.view(np.complex64)[..., 0]
        spectrum *= self._amplitude
        screen = fft.irfft2(spectrum, s=(size, size), norm="forward", workers=1, overwrite_x=True)
        coefficients = np.concatenate([screen, screen[:, : self.margin]], axis=1)
        pairs = rng.standard_normal((len(self._wave_rms), 2))
        # A real wave is twice the real part of its complex amplitude.
        waves = 2 * self._wave_rms * (pairs[:, 0] + 1j * pairs[:, 1]) / math.sqrt(2)
        return TurbulenceRealisation(np.asarray(coefficients, np.float32), waves)

    def _spectral_amplitude(self, r0_m: float, outer_scale_m: float) -> NDArray[np.float32]:
        """Rms of the real and of the imaginary part of each Fourier component ``(size, size / 2 + 1)``."""
        size, step = self.size, 1 / (self.size * self.pixel_m)
        fx = np.arange(size // 2 + 1) * step
        fy = np.asarray(fft.fftfreq(size, self.pixel_m), dtype=np.float64)
        power = power_spectrum(fx**2 + fy[:, None] ** 2, r0_m, outer_scale_m) * step**2
        rows = np.r_[0 : _N_INTEGRATED_CELLS + 1, -_N_INTEGRATED_CELLS:0]
        u, v = np.meshgrid(fx[: _N_INTEGRATED_CELLS + 1], fy[rows])
        u[0, 0] = step  # any frequency but zero, whose power is removed below
        power[rows, : _N_INTEGRATED_CELLS + 1] = _cell_power(u, v, step, r0_m, outer_scale_m)
        power[0, 0] = 0.0
        # In the self-conjugate columns the transform keeps only half of the power.
        power[:, [0, -1]] *= 2
        gain_x, gain_y = spline_gain(fx * self.pixel_m), spline_gain(fy * self.pixel_m)
        return np.asarray(np.sqrt(power / 2) * np.outer(gain_y, gain_x), dtype=np.float32)
