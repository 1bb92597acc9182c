"""Strength of the turbulence, pupil diameters over r0, from open-loop or pseudo-open-loop modes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

#: First mode that is used, counted from 0: the outer scale and vibrations change those of the first three
#: radial orders. Share of the modes up to the last one: the highest, of the edge of the mirror, differ from
#: those of the turbulence.
FIRST_MODE, _LAST_SHARE = 9, 0.75
#: Fewest modes of an estimate.
MIN_MODES = 10
#: Wavelength for which r0 and seeing are given, metres, and FWHM of the seeing in lambda / r0.
REFERENCE_WAVELENGTH_M, _SEEING_FACTOR = 500e-9, 0.98


def noll_residual(n_modes: int) -> float:
    """Phase variance beyond piston and the first ``n_modes`` modes, for a pupil as wide as r0, in rad^2.

    ``0.2944 J^(-sqrt(3) / 2)`` with ``J = n_modes + 1`` (Noll 1976), for ten or more modes in
    the order of their variance.
    """
    return float(0.2944 * (n_modes + 1.0) ** (-np.sqrt(3) / 2))


def used_modes(n_modes: int) -> slice:
    """The modes of ``n_modes`` that :func:`turbulence_strength` uses; empty if they are too few."""
    last = int(_LAST_SHARE * n_modes)
    return slice(FIRST_MODE, last if last - FIRST_MODE >= MIN_MODES else FIRST_MODE)


def turbulence_strength(pairs_rad: NDArray[np.floating], n_modes: int) -> float:
    """Pupil diameters over r0 from modes in pairs of successive frames.

    The modes from ``a`` to ``b`` have the variance ``(N(a) - N(b)) (D / r0)^(5/3)`` of Kolmogorov turbulence,
    with the residuals ``N`` of :func:`noll_residual`. The covariance of the two frames of a pair takes the
    place of the variance, because it contains no photon and read noise.

    Parameters
    ----------
    pairs_rad
        Coefficients ``(n, 2, k)`` of the :func:`used_modes`, in radians rms, uncorrected.
    n_modes
        Number of modes of the basis: Karhunen-Loeve or Zernike, orthonormal over the pupil.

    Returns
    -------
    float
        0 if the covariance is not positive.

    Raises
    ------
    ValueError
        Fewer than two pairs, or too few modes.
    """
    used = used_modes(n_modes)
    pairs = np.asarray(pairs_rad, float)
    if used.stop <= used.start:
        raise ValueError(f"{n_modes} modes; the strength of the turbulence needs at least 26")
    if len(pairs) < 2 or pairs.shape[1:] != (2, used.stop - used.start):
        raise ValueError(f"{pairs.shape}: 2 or more pairs of {used.stop - used.start} modes are needed")
    pairs = pairs - pairs.mean(axis=(0, 1))
    n = 2 * len(pairs)
    variance = float((pairs[:, 0] * pairs[:, 1]).sum(axis=1).mean()) * n / (n - 1)
    expected = noll_residual(used.start) - noll_residual(used.stop)
    return float((max(variance, 0.0) / expected) ** 0.6)


def fried_parameter(strength: float, pupil_m: float, wavelength_m: float) -> float:
    """Fried parameter r0 in metres at 500 nm from ``D / r0`` at a wavelength: r0 rises as ``lambda^1.2``."""
    return float(pupil_m / strength * (REFERENCE_WAVELENGTH_M / wavelength_m) ** 1.2)


def seeing_arcsec(r0_m: float) -> float:
    """FWHM of the seeing in arc seconds at 500 nm, ``0.98 lambda / r0``."""
    return float(np.degrees(_SEEING_FACTOR * REFERENCE_WAVELENGTH_M / r0_m) * 3600)
