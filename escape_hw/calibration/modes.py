"""Modal bases: Karhunen-Loeve and zonal, as mode-to-command matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import special

from escape_hw.errors import CalibrationError

#: On a symmetric mirror modes come in pairs of equal variance, and rounding would decide how a pair lies
#: in its plane (and which half of one is cut off). This much anisotropy decides it instead.
_LEAN = 1e-4


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


def von_karman_covariance(distance_m: NDArray[np.float64], outer_scale_m: float) -> NDArray[np.float64]:
    """Covariance of von Karman phase at a distance, relative to the variance.

    ``x^(5/6) K_5/6(x) 2^(1/6) / Gamma(5/6)`` with ``x = 2 pi r / L0``: the Fourier transform of the
    power spectrum ``(f^2 + 1 / L0^2)^(-11/6)`` (Conan 2000).

    Parameters
    ----------
    distance_m
        Distances of any shape in metres.
    outer_scale_m
        Outer scale in metres.
    """
    x = 2 * np.pi * np.maximum(distance_m, 1e-9 * outer_scale_m) / outer_scale_m
    return np.asarray(x ** (5 / 6) * special.kv(5 / 6, x) * (2 ** (1 / 6) / special.gamma(5 / 6)))


def karhunen_loeve(
    surfaces: NDArray[np.float64],
    pupil: NDArray[np.bool_],
    pixel_m: float,
    n_modes: int,
    outer_scale_m: float,
) -> NDArray[np.float64]:
    """Karhunen-Loeve modes of von Karman turbulence within the span of the influence functions.

    Double diagonalisation (Gendron 1995): modes whose turbulent coefficients are uncorrelated, ordered
    by falling variance, and which are orthonormal over the pupil once their piston is taken out; no
    sensor sees it.

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
    inside = surfaces[:, pupil]
    inside = inside - inside.mean(axis=1, keepdims=True)
    orthonormal = _orthonormal(inside, pupil, n_modes)
    covariance = _turbulent_covariance(inside, pupil, pixel_m, outer_scale_m)
    variance, turn = np.linalg.eigh(orthonormal.T @ covariance @ orthonormal)
    m2c = orthonormal @ turn[:, np.argsort(variance)[::-1]]
    return fix_signs(unit_rms(m2c, surfaces, pupil))


def _orthonormal(inside: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int) -> NDArray[np.float64]:
    """Modes ``(n_act, n_modes)`` orthonormal over the pupil that span what the mirror makes best.

    ``inside (n_act, n_pixels)`` are the influence functions over the pupil, without piston.
    """
    n_act = len(inside)
    gram = inside @ inside.T / inside.shape[1]
    rows, columns = np.nonzero(pupil)
    lean = np.square(columns - columns.mean()) - np.square(rows - rows.mean())
    leaning = (inside * (1 + _LEAN * lean / np.abs(lean).max())) @ inside.T / inside.shape[1]
    values, vectors = np.linalg.eigh(leaning)
    keep = values > values[-1] * 1e-9
    if n_modes > min(int(keep.sum()), n_act - 1):
        raise CalibrationError(
            f"{n_modes} modes asked for; this mirror of {n_act} actuators makes at most "
            f"{min(int(keep.sum()), n_act - 1)} without piston; lower basis.n_modes"
        )
    order = np.argsort(values)[::-1][:n_modes]
    chosen = vectors[:, order] / np.sqrt(values[order])
    return np.asarray(np.linalg.solve(np.linalg.cholesky(chosen.T @ gram @ chosen), chosen.T).T)


def _turbulent_covariance(
    inside: NDArray[np.float64], pupil: NDArray[np.bool_], pixel_m: float, outer_scale_m: float
) -> NDArray[np.float64]:
    """Covariance of what turbulence puts on each influence function ``(n_act, n_act)``, of unit trace."""
    n_act, n = len(inside), pupil.shape[0]
    padded = np.zeros((n_act, 2 * n, 2 * n))
    padded[:, :n, :n][:, pupil] = inside
    # With twice the pupil's size every pair of pixels keeps its own distance: nothing wraps around.
    apart = np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n)) * pixel_m
    kernel = von_karman_covariance(np.hypot((1 + _LEAN) * apart[:, None], apart), outer_scale_m)
    spectrum = np.fft.rfft2(kernel).real
    transform = np.fft.rfft2(padded).reshape(n_act, -1)
    # rfft2 keeps half the plane: the columns between the first and the last count twice.
    twice = np.full(n + 1, 2.0)
    twice[[0, -1]] = 1.0
    weighted = transform * (spectrum * twice).ravel()
    covariance = weighted.real @ transform.real.T + weighted.imag @ transform.imag.T
    # An overall factor turns no mode.
    return np.asarray(covariance / np.trace(covariance))


def zonal(surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int) -> NDArray[np.float64]:
    """Single actuators as modes ``(n_act, n_modes)``, the first ``n_modes`` of them."""
    n_act = surfaces.shape[0]
    if n_modes > n_act:
        raise CalibrationError(f"{n_modes} modes asked for; this mirror has {n_act} actuators")
    return unit_rms(np.eye(n_act)[:, :n_modes], surfaces, pupil)
