"""Modal bases from shapes on the pupil, Zernike polynomials and Fourier modes, as the mirror makes them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import count, islice
from math import factorial

import numpy as np
from numpy.typing import NDArray

from escape_hw.calibration.modes import unit_rms
from escape_hw.errors import CalibrationError

#: Modes whose surfaces are less independent than this (ratio of singular values) are not a basis.
_INDEPENDENT = 1e-3


def zernike(surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int) -> NDArray[np.float64]:
    """Zernike modes without piston, in Noll's order ``(n_act, n_modes)`` (Noll 1976).

    Parameters
    ----------
    surfaces
        Influence functions ``(n_act, n, n)``.
    pupil
        Boolean ``(n, n)``.
    n_modes
        How many.

    Raises
    ------
    CalibrationError
        The mirror cannot tell so many of them apart.
    """
    x, y = _unit_coordinates(pupil)
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    shapes = [_radial(n, abs(m), r) * _azimuthal(m, angle) for n, m in islice(_noll(), n_modes)]
    return _made_by(surfaces, pupil, np.array(shapes), "Zernike")


def fourier(surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int) -> NDArray[np.float64]:
    """Cosines and sines of whole cycles across the pupil's diameter, lowest frequency first.

    Tip and tilt, which no whole cycle makes, come first.

    Parameters
    ----------
    surfaces, pupil, n_modes
        As for :func:`zernike`.

    Raises
    ------
    CalibrationError
        The mirror cannot tell so many of them apart.
    """
    x, y = _unit_coordinates(pupil)
    shapes = [x, y]
    for across, down in _frequencies():
        if len(shapes) >= n_modes:
            break
        phase = np.pi * (across * x + down * y)
        shapes += [np.cos(phase), np.sin(phase)]
    return _made_by(surfaces, pupil, np.array(shapes[:n_modes]), "Fourier")


def _unit_coordinates(pupil: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates ``(n_pixels,)`` along columns and rows, in radii of the circle around the pupil."""
    rows, columns = np.nonzero(pupil)
    middle = (np.array(pupil.shape) - 1) / 2
    y, x = rows - middle[0], columns - middle[1]
    radius = float(np.hypot(x, y).max())
    return x / radius, y / radius


def _noll() -> Iterator[tuple[int, int]]:
    """Radial order and azimuthal frequency (negative: sine) in Noll's order, from tip on."""
    j = 1
    for n in count(1):
        for m in range(n % 2, n + 1, 2):
            for _ in range(1 if m == 0 else 2):
                j += 1
                # Noll: even j are cosines, odd ones sines.
                yield n, m if j % 2 == 0 else -m


def _radial(n: int, m: int, r: NDArray[np.float64]) -> NDArray[np.float64]:
    total = np.zeros_like(r)
    for k in range((n - m) // 2 + 1):
        below = factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
        total += (-1) ** k * factorial(n - k) / below * r ** (n - 2 * k)
    return total


def _azimuthal(m: int, angle: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(np.cos(m * angle) if m >= 0 else np.sin(-m * angle))


def _frequencies() -> Iterator[tuple[int, int]]:
    """Half of all pairs of whole frequencies, by rising length: the other half are their negatives."""
    reach = 64
    pairs = [(a, b) for a in range(reach) for b in range(-reach, reach) if a > 0 or b > 0]
    yield from sorted(pairs, key=lambda f: (f[0] ** 2 + f[1] ** 2, -f[0], -f[1]))


def _made_by(
    surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], shapes: NDArray[np.float64], name: str
) -> NDArray[np.float64]:
    """The mirror's least-squares approach to shapes ``(n_modes, n_pixels)``, piston aside."""
    inside = surfaces[:, pupil]
    inside = inside - inside.mean(axis=1, keepdims=True)
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    m2c = np.linalg.lstsq(inside.T, shapes.T, rcond=1e-6)[0]
    made = m2c.T @ inside
    values = np.linalg.svd(made / np.linalg.norm(made, axis=1, keepdims=True), compute_uv=False)
    if len(shapes) > len(inside) or values[-1] < _INDEPENDENT * values[0]:
        raise CalibrationError(
            f"this mirror of {len(inside)} actuators cannot tell {len(shapes)} {name} modes apart; "
            "lower basis.n_modes, or choose basis.kind = 'kl'"
        )
    return unit_rms(m2c, surfaces, pupil)
