"""Camera detector: photon, multiplication, read and fixed-pattern noise, full well, quantisation."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray
from scipy import special

#: Largest mean for the Poisson tables; above it a Gaussian of the same mean and variance is accurate.
_MAX_TABLE_MEAN = np.float32(20.0)
#: Tables per unit of the mean, numbers per table, and starting points of the search in each table.
_MEANS_PER_UNIT, _TABLE_LENGTH, _N_ENTRIES = 16, 64, 256


def _poisson_tables() -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
    """Tables of :func:`_draw_poisson` for means of 0, 1/16, 2/16, ...

    The probability ``(n_means, 64)`` of at most ``k``, and the first ``k`` to compare with a uniform number,
    by its first 8 bits ``(n_means, 256)``.
    """
    means = np.arange(int(_MAX_TABLE_MEAN * _MEANS_PER_UNIT) + 1) / _MEANS_PER_UNIT
    exact = special.pdtr(np.arange(_TABLE_LENGTH), means[:, None])
    exact[:, -1] = 2.0  # ends every search
    starts = np.arange(_N_ENTRIES) / _N_ENTRIES
    entry = np.array([np.searchsorted(row, starts, side="right") for row in exact], np.uint8)
    return exact.astype(np.float32), entry


@njit(cache=True, nogil=True, inline="always")
def _uniform_pair(key, index):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Two uniform numbers in [0, 1): a hash of ``index`` under a 64-bit key, without state.

    Uses the finaliser of SplitMix64 (Steele, Lea and Flood 2014).
    """
    z = np.uint64(key) + np.uint64(index + 1) * np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    scale = np.float32(1.0 / (1 << 24))
    return np.float32(z >> np.uint64(40)) * scale, np.float32(
        (z >> np.uint64(8)) & np.uint64(0xFFFFFF)
    ) * scale


@njit(cache=True, nogil=True, inline="always")
def _draw_poisson(mean, uniform_a, uniform_b, cumulative, entry):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Draw a Poisson number of a mean up to 20 from two uniform numbers.

    The sum of two Poisson numbers: one whose mean is on the tables' grid, by inversion from the tabulated
    starting point, and one of the remaining mean, by inversion from zero.
    """
    row = int(mean * np.float32(16))
    u = uniform_a
    k = int(entry[row, int(u * np.float32(256))])
    while cumulative[row, k] <= u:
        k += 1
    remainder = mean - np.float32(row) * np.float32(1 / 16)
    # exp(-remainder) for remainder < 1/16; the next term is below float32 resolution.
    term = np.float32(1) - remainder * (
        np.float32(1)
        - remainder * (np.float32(0.5) - remainder * (np.float32(1 / 6) - remainder * np.float32(1 / 24)))
    )
    total, more = term, np.float32(0)
    while total <= uniform_b and more < np.float32(8):
        more += np.float32(1)
        term *= remainder / more
        total += term
    return np.float32(k) + more


#: Read noise in electrons above which faint light is treated as Gaussian: the skewness of the sum is
#: below 0.385 / read noise, less than a tenth.
COUNTING_NOISE_E = 4.0


@njit(cache=True, fastmath=True, nogil=True)
def _digitise(value, k, gain, offset, well, top, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    """Store the counts of a pixel, clipped to full well and converter range; return 1 if saturated."""
    full = value >= well
    value = min(value, well)
    count = max(np.float32(0), value * gain[k] + offset[k])
    level = min(np.int32(count + np.float32(0.5)), np.int32(top))
    # A full pixel reads the top of the converter whatever its gain and offset.
    if full:
        level = np.int32(top)
    out[k] = level
    return 1 if level == top else 0


@njit(cache=True, fastmath=True, nogil=True)
def _expose_gaussian(  # type: ignore[no-untyped-def]
    intensity, photons, dark, read2, excess2, gain, offset, noise, start, sign, well, top, out
):  # pragma: no cover
    saturated = 0
    for k in range(intensity.size):
        mean = intensity[k] * photons + dark
        value = mean + sign * noise[start + k] * np.sqrt(mean * excess2 + read2)
        saturated += _digitise(value, k, gain, offset, well, top, out)
    return saturated


@njit(cache=True, fastmath=True, nogil=True)
def _expose_counting(settings, key, cumulative, entry):  # type: ignore[no-untyped-def]  # pragma: no cover
    intensity, photons, dark, read2, excess2, gain, offset, noise, start, sign, well, top, out = settings
    saturated = 0
    read = np.sqrt(read2)
    spread = excess2 - np.float32(1)
    for k in range(intensity.size):
        mean = intensity[k] * photons + dark
        normal = sign * noise[start + k]
        if mean >= _MAX_TABLE_MEAN:
            value = mean + normal * np.sqrt(mean * excess2 + read2)
        else:
            uniform_a, uniform_b = _uniform_pair(key, k)
            value = _draw_poisson(mean, uniform_a, uniform_b, cumulative, entry)
            if spread > 0 and value > 0:
                # Gamma distribution of mean value and variance value x spread (Wilson and Hilferty 1931).
                small = spread / (np.float32(9) * value)
                root = np.float32(1) - small + noise[noise.size - 1 - start - k] * np.sqrt(small)
                value *= max(root, np.float32(0)) ** 3
            value += normal * read
        saturated += _digitise(value, k, gain, offset, well, top, out)
    return saturated


class Detector:
    """Converts intensities to counts.

    Shot and read noise are one Gaussian of variance ``mean + read_noise^2``, which suits cameras with
    several electrons of read noise. If the read noise is below :data:`COUNTING_NOISE_E`, means below 20
    electrons are Poisson distributed, and gamma distributed after multiplication. Normal deviates come
    from a pool, entered at a random position with a random sign in each frame, which takes a tenth of
    the time of drawing new ones.

    Parameters
    ----------
    shape, bit_depth
        Region (rows, columns), and bits of the converter.
    full_well_e
        Electrons at which a pixel saturates; full scale of the converter.
    read_noise_e, dark_e
        Read noise (rms) and dark signal per frame in electrons before multiplication.
    background_e
        Mean black level in electrons, without shot noise.
    fixed_pattern
        Relative scatter of the pixels' gains; black levels scatter by this share of 100 counts.
    excess_noise
        Excess noise factor F: shot noise is F times that of the light. 1 without multiplication, 1.25
        for an avalanche photodiode array, 1.41 for an electron-multiplying CCD.
    """

    POOL = 1 << 22

    def __init__(
        self,
        shape: tuple[int, int],
        bit_depth: int,
        full_well_e: float,
        read_noise_e: float,
        dark_e: float,
        background_e: float,
        fixed_pattern: float,
        rng: np.random.Generator,
        excess_noise: float = 1.0,
    ) -> None:
        size = shape[0] * shape[1]
        self.shape, self.top = shape, 2**bit_depth - 1
        self._rng = rng
        adu = self.top / full_well_e
        self._gain = (adu * (1 + fixed_pattern * rng.standard_normal(size))).astype(np.float32)
        scatter = 100 * fixed_pattern * rng.standard_normal(size)
        self._offset = (adu * background_e + scatter).astype(np.float32)
        self._dark, self._read2 = np.float32(dark_e), np.float32(read_noise_e**2)
        self._excess2 = np.float32(excess_noise**2)
        self._well = np.float32(full_well_e)
        self._noise = rng.standard_normal(max(self.POOL, 2 * size), dtype=np.float32)
        self._tables = _poisson_tables() if read_noise_e < COUNTING_NOISE_E else None

    def set_rng(self, rng: np.random.Generator) -> None:
        """Replace the source of randomness; gains, offsets and the pool of deviates are kept."""
        self._rng = rng

    def expose(
        self, intensity: NDArray[np.float32], photons: float, sky_e: float = 0.0
    ) -> tuple[NDArray[np.uint16], int]:
        """Expose one frame; return its counts ``(rows, columns)`` and the number of saturated pixels.

        ``intensity (rows, columns)`` is multiplied by ``photons`` electrons; ``sky_e`` is additional uniform
        light in electrons per pixel.
        """
        out = np.empty(self.shape, np.uint16)
        start = int(self._rng.integers(0, self._noise.size - intensity.size))
        sign = np.float32(1 if self._rng.random() < 0.5 else -1)
        settings = (
            intensity.ravel(), np.float32(photons), self._dark + np.float32(sky_e), self._read2,
            self._excess2, self._gain, self._offset, self._noise, start, sign, self._well, self.top,
            out.ravel(),
        )  # fmt: skip
        if self._tables is None:
            saturated = _expose_gaussian(*settings)
        else:
            key = self._rng.integers(0, 1 << 63, dtype=np.uint64)
            saturated = _expose_counting(settings, key, *self._tables)
        return out, int(saturated)
