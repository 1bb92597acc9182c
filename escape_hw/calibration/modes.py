"""Modal bases: Karhunen-Loeve and zonal, as mode-to-command matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import CalibrationError


def unit_rms(
    m2c: NDArray[np.float64], surfaces: NDArray[np.float64], pupil: NDArray[np.bool_]
) -> NDArray[np.float64]:
    """Scale the columns of a mode-to-command matrix to unit rms surface over the pupil.

    Parameters
    ----------
    m2c
        ``(n_act, n_modes)``.
    surfaces
        Influence functions ``(n_act, n, n)`` in fractions of full stroke.
    pupil
        Boolean ``(n, n)``.
    """
    inside = surfaces[:, pupil]
    inside = inside - inside.mean(axis=1, keepdims=True)
    gram = inside @ inside.T / inside.shape[1]
    return np.asarray(m2c / np.sqrt(np.einsum("am,ab,bm->m", m2c, gram, m2c)))


def fix_signs(m2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Turn every mode so that its largest coefficient is positive; ties go to the first actuator."""
    size = np.abs(m2c)
    pivot = np.argmax(size >= size.max(axis=0) * (1 - 1e-6), axis=0)
    return np.asarray(m2c * np.sign(m2c[pivot, np.arange(m2c.shape[1])]))


def karhunen_loeve(
    surfaces: NDArray[np.float64],
    pupil: NDArray[np.bool_],
    pixel_m: float,
    n_modes: int,
    outer_scale_m: float,
) -> NDArray[np.float64]:
    """Karhunen-Loeve modes of von Karman turbulence within the span of the influence functions.

    Double diagonalisation (Gendron 1995): modes orthonormal over the pupil, without piston, whose
    turbulent coefficients are uncorrelated; ordered by falling variance.

    Parameters
    ----------
    surfaces
        Influence functions ``(n_act, n, n)``.
    pupil
        Boolean ``(n, n)``.
    pixel_m
        Pixel size in metres.
    n_modes
        How many modes to keep, at most ``n_act - 1``.
    outer_scale_m
        Outer scale of the turbulence in metres.

    Returns
    -------
    ndarray, ``(n_act, n_modes)``
        Columns with unit rms surface over the pupil, signs fixed.

    Raises
    ------
    CalibrationError
        More modes than the mirror can make.
    """
    n_act, n = surfaces.shape[0], pupil.shape[0]
    inside = surfaces[:, pupil]
    inside = inside - inside.mean(axis=1, keepdims=True)
    values, vectors = np.linalg.eigh(inside @ inside.T / inside.shape[1])
    keep = values > values[-1] * 1e-9
    if n_modes > min(int(keep.sum()), n_act - 1):
        raise CalibrationError(
            f"{n_modes} modes asked for; this mirror of {n_act} actuators makes at most "
            f"{min(int(keep.sum()), n_act - 1)} without piston; lower basis.n_modes"
        )
    order = np.argsort(values)[::-1][:n_modes]
    orthonormal = vectors[:, order] / np.sqrt(values[order])
    padded = np.zeros((n_act, 2 * n, 2 * n))
    padded[:, :n, :n] = np.where(pupil, surfaces, 0.0)
    padded[:, :n, :n][:, pupil] = inside
    f = np.fft.fftfreq(2 * n, pixel_m)
    spectrum = (f[:, None] ** 2 + f[None, : n + 1] ** 2 + outer_scale_m**-2) ** (-11 / 6)
    transform = np.fft.rfft2(padded)
    # rfft2 keeps half the plane: the columns between the first and the last count twice.
    twice = np.full(n + 1, 2.0)
    twice[[0, -1]] = 1.0
    weighted = (transform * np.sqrt(spectrum * twice)).reshape(n_act, -1)
    covariance = (weighted.real @ weighted.real.T + weighted.imag @ weighted.imag.T) / inside.shape[1]
    turbulent = orthonormal.T @ covariance @ orthonormal
    variance, turn = np.linalg.eigh(turbulent)
    m2c = orthonormal @ turn[:, np.argsort(variance)[::-1]]
    return fix_signs(unit_rms(m2c, surfaces, pupil))


def zonal(surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int) -> NDArray[np.float64]:
    """Single actuators as modes ``(n_act, n_modes)``, the first ``n_modes`` of them."""
    n_act = surfaces.shape[0]
    if n_modes > n_act:
        raise CalibrationError(f"{n_modes} modes asked for; this mirror has {n_act} actuators")
    return unit_rms(np.eye(n_act)[:, :n_modes], surfaces, pupil)
