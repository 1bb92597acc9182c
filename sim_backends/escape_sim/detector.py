"""Camera detector: photon, read and fixed-pattern noise, full well, quantisation."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray


@njit(cache=True, fastmath=True, nogil=True)
def _expose(intensity, photons, dark, read2, gain, offset, noise, start, sign, well, top, out):  # type: ignore[no-untyped-def]  # pragma: no cover
    saturated = 0
    n = intensity.size
    for k in range(n):
        mean = intensity[k] * photons + dark
        value = mean + sign * noise[start + k] * np.sqrt(mean + read2)
        full = value >= well
        value = min(value, well)
        count = value * gain[k] + offset[k]
        count = max(np.float32(0), count)
        level = np.int32(count + np.float32(0.5))
        level = min(level, np.int32(top))
        # The pattern is one of sensitivities: whatever its own, a full pixel stands at the top.
        if full:
            level = np.int32(top)
        if level == top:
            saturated += 1
        out[k] = level
    return saturated


class Detector:
    """Turns intensities into counts.

    Shot and read noise together are Gaussian with variance ``mean + read_noise^2``: exact enough
    for a CMOS camera whose read noise is several electrons, not meant for photon counting. The
    normal deviates come from a long pool, entered at a random place with a random sign for each
    frame, which costs a tenth of drawing them afresh.

    Parameters
    ----------
    shape
        Region (rows, columns).
    bit_depth
        Bits of the converter.
    full_well_e
        Electrons at which a pixel saturates; the converter's top stands at this level.
    read_noise_e, dark_e
        Read noise (rms) and dark signal per frame in electrons.
    background_e
        Mean black level in electrons; it carries no shot noise.
    fixed_pattern
        Relative scatter of the pixels' gains; their black levels scatter by the same share of 100
        counts.
    rng
        Source of randomness.
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
    ) -> None:
        size = shape[0] * shape[1]
        self.shape, self.top = shape, 2**bit_depth - 1
        self._rng = rng
        adu = self.top / full_well_e
        self._gain = (adu * (1 + fixed_pattern * rng.standard_normal(size))).astype(np.float32)
        scatter = 100 * fixed_pattern * rng.standard_normal(size)
        self._offset = (adu * background_e + scatter).astype(np.float32)
        self._dark, self._read2 = np.float32(dark_e), np.float32(read_noise_e**2)
        self._well = np.float32(full_well_e)
        self._noise = rng.standard_normal(max(self.POOL, 2 * size), dtype=np.float32)

    def expose(self, intensity: NDArray[np.float32], photons: float) -> tuple[NDArray[np.uint16], int]:
        """One frame.

        Parameters
        ----------
        intensity
            Relative intensity ``(rows, columns)``.
        photons
            Electrons per unit of intensity.

        Returns
        -------
        frame : ndarray of uint16, ``(rows, columns)``
        n_saturated : int
        """
        out = np.empty(self.shape, np.uint16)
        start = int(self._rng.integers(0, self._noise.size - intensity.size))
        sign = np.float32(1 if self._rng.random() < 0.5 else -1)
        saturated = _expose(
            intensity.ravel(), np.float32(photons), self._dark, self._read2, self._gain, self._offset,
            self._noise, start, sign, self._well, self.top, out.ravel(),
        )  # fmt: skip
        return out, int(saturated)
