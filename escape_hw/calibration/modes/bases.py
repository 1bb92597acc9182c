"""Modal bases as mode-to-command matrices: Karhunen-Loeve, zonal, Zernike, Fourier, or from a file."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import count, islice
from math import factorial

import numpy as np
from numpy.typing import NDArray
from scipy import special

from escape_hw.bench import Bench
from escape_hw.config.system import SystemConfig
from escape_hw.errors import CalibrationError, ConfigError

#: Relative anisotropy that separates pairs of modes with equal variance on a symmetric mirror, whose
#: orientation would otherwise depend on rounding errors.
_ANISOTROPY = 1e-4
#: Mean square over the pupil per squared command, relative to the best, that a combination of actuators needs
#: to be part of Karhunen-Loeve modes: commands up to thirty times larger.
_LEAST_RESPONSE = 1e-3
#: Ratio of singular values below which the surfaces of modes are linearly dependent.
_MIN_SINGULAR_RATIO = 1e-3
#: Outer scale of the turbulence assumed for the modal basis, in pupil diameters.
_OUTER_SCALE = 4.0


def scale_to_unit_rms(
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
    pupil_surfaces = _pupil_surfaces(surfaces, pupil)
    gram = pupil_surfaces @ pupil_surfaces.T / pupil_surfaces.shape[1]
    return np.asarray(m2c / np.sqrt(np.einsum("am,ab,bm->m", m2c, gram, m2c)))


def _pupil_surfaces(surfaces: NDArray[np.float64], pupil: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Influence functions over the pupil without piston ``(n_act, n_pixels)``."""
    inside = surfaces[:, pupil]
    return np.asarray(inside - inside.mean(axis=1, keepdims=True))


def fix_signs(m2c: NDArray[np.float64]) -> NDArray[np.float64]:
    """Flip modes ``(n_act, n_modes)`` so that the largest coefficient, the first of equals, is positive."""
    size = np.abs(m2c)
    pivot = np.argmax(size >= size.max(axis=0) * (1 - 1e-6), axis=0)
    return np.asarray(m2c * np.sign(m2c[pivot, np.arange(m2c.shape[1])]))


def von_karman_covariance(distance_m: NDArray[np.float64], outer_scale_m: float) -> NDArray[np.float64]:
    """Covariance of von Karman phase at a distance, divided by the variance.

    ``x^(5/6) K_5/6(x) 2^(1/6) / Gamma(5/6)`` with ``x = 2 pi r / L0``: the Fourier transform of the
    power spectrum ``(f^2 + 1 / L0^2)^(-11/6)`` (Conan 2000).

    ``distance_m``: distances of any shape in metres; ``outer_scale_m``: outer scale in metres.
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

    Double diagonalisation (Gendron 1995): modes that are orthonormal over the pupil without piston, with
    uncorrelated coefficients of the turbulence, ordered by decreasing variance; the first ``n_modes`` of
    all that the mirror makes without large commands (:data:`_LEAST_RESPONSE`).

    Returns ``(n_act, n_modes)``, columns with unit rms surface over the pupil, signs fixed.

    Parameters
    ----------
    surfaces
        Influence functions ``(n_act, n, n)``.
    pupil
        Boolean ``(n, n)``.
    pixel_m
        Pixel size in metres.
    n_modes
        Number of modes, at most ``n_act - 1``.
    outer_scale_m
        Outer scale of the turbulence in metres.

    Raises
    ------
    CalibrationError
        More modes than the mirror can make.
    """
    pupil_surfaces = _pupil_surfaces(surfaces, pupil)
    orthonormal = _orthonormal_modes(pupil_surfaces, pupil, n_modes)
    covariance = _turbulence_covariance(pupil_surfaces, pupil, pixel_m, outer_scale_m)
    variance, rotation = np.linalg.eigh(orthonormal.T @ covariance @ orthonormal)
    m2c = orthonormal @ rotation[:, np.argsort(variance)[::-1][:n_modes]]
    return fix_signs(scale_to_unit_rms(m2c, surfaces, pupil))


def _orthonormal_modes(
    pupil_surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int
) -> NDArray[np.float64]:
    """Modes ``(n_act, n_modes or more)``, orthonormal over the pupil, that need the smallest commands.

    More than ``n_modes``, because tip, tilt and focus need the actuators at the rim, which respond weakly.
    """
    n_act = len(pupil_surfaces)
    gram = pupil_surfaces @ pupil_surfaces.T / pupil_surfaces.shape[1]
    rows, columns = np.nonzero(pupil)
    anisotropy = np.square(columns - columns.mean()) - np.square(rows - rows.mean())
    anisotropic_gram = (
        (pupil_surfaces * (1 + _ANISOTROPY * anisotropy / np.abs(anisotropy).max()))
        @ pupil_surfaces.T
        / pupil_surfaces.shape[1]
    )
    values, vectors = np.linalg.eigh(anisotropic_gram)
    significant = values > values[-1] * 1e-9
    if n_modes > min(int(significant.sum()), n_act - 1):
        raise CalibrationError(
            f"{n_modes} modes requested; this mirror of {n_act} actuators makes at most "
            f"{min(int(significant.sum()), n_act - 1)} without piston; lower basis.n_modes"
        )
    order = np.argsort(values)[::-1][: max(n_modes, int((values > values[-1] * _LEAST_RESPONSE).sum()))]
    chosen = vectors[:, order] / np.sqrt(values[order])
    return np.asarray(np.linalg.solve(np.linalg.cholesky(chosen.T @ gram @ chosen), chosen.T).T)


def _turbulence_covariance(
    pupil_surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], pixel_m: float, outer_scale_m: float
) -> NDArray[np.float64]:
    """Covariance of the turbulence projected on the influence functions ``(n_act, n_act)``, of unit trace."""
    n_act, n = len(pupil_surfaces), pupil.shape[0]
    padded = np.zeros((n_act, 2 * n, 2 * n))
    padded[:, :n, :n][:, pupil] = pupil_surfaces
    # Twice the pupil's size, so that distances do not wrap around.
    offsets_m = np.minimum(np.arange(2 * n), 2 * n - np.arange(2 * n)) * pixel_m
    kernel = von_karman_covariance(np.hypot((1 + _ANISOTROPY) * offsets_m[:, None], offsets_m), outer_scale_m)
    spectrum = np.fft.rfft2(kernel).real
    transform = np.fft.rfft2(padded).reshape(n_act, -1)
    # rfft2 keeps half the plane: the columns between the first and the last count twice.
    half_plane_weights = np.full(n + 1, 2.0)
    half_plane_weights[[0, -1]] = 1.0
    weighted = transform * (spectrum * half_plane_weights).ravel()
    covariance = weighted.real @ transform.real.T + weighted.imag @ transform.imag.T
    return np.asarray(covariance / np.trace(covariance))


def zonal(surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int) -> NDArray[np.float64]:
    """Single actuators as modes ``(n_act, n_modes)``, the first ``n_modes`` of them."""
    n_act = surfaces.shape[0]
    if n_modes > n_act:
        raise CalibrationError(
            f"{n_modes} modes requested; this mirror has {n_act} actuators; lower basis.n_modes"
        )
    return scale_to_unit_rms(np.eye(n_act)[:, :n_modes], surfaces, pupil)


def zernike(surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int) -> NDArray[np.float64]:
    """Zernike modes without piston, in Noll's order ``(n_act, n_modes)`` (Noll 1976).

    ``surfaces``: influence functions ``(n_act, n, n)``; ``pupil``: Boolean ``(n, n)``.

    Raises
    ------
    CalibrationError
        The mirror cannot make so many independent modes.
    """
    x, y = _unit_coordinates(pupil)
    r, angle = np.hypot(x, y), np.arctan2(y, x)
    shapes = [
        _radial_polynomial(n, abs(m), r) * (np.cos(m * angle) if m >= 0 else np.sin(-m * angle))
        for n, m in islice(_noll_orders(), n_modes)
    ]
    return _fit_shapes(surfaces, pupil, np.array(shapes), "Zernike")


def fourier(surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], n_modes: int) -> NDArray[np.float64]:
    """Tip, tilt, then cosines and sines of whole cycles across the pupil's diameter, lowest frequency first.

    ``surfaces``, ``pupil``, ``n_modes`` and the result as for :func:`karhunen_loeve`.

    Raises
    ------
    CalibrationError
        The mirror cannot make so many independent modes.
    """
    x, y = _unit_coordinates(pupil)
    shapes = [x, y]
    for fx, fy in _fourier_frequencies():
        if len(shapes) >= n_modes:
            break
        phase = np.pi * (fx * x + fy * y)
        shapes += [np.cos(phase), np.sin(phase)]
    return _fit_shapes(surfaces, pupil, np.array(shapes[:n_modes]), "Fourier")


def _unit_coordinates(pupil: NDArray[np.bool_]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Coordinates ``(n_pixels,)`` along columns and rows, in radii of the circle around the pupil."""
    rows, columns = np.nonzero(pupil)
    centre = (np.array(pupil.shape) - 1) / 2
    y, x = rows - centre[0], columns - centre[1]
    radius = float(np.hypot(x, y).max())
    return x / radius, y / radius


def _noll_orders() -> Iterator[tuple[int, int]]:
    """Radial order and azimuthal frequency (negative: sine) in Noll's order, from tip on."""
    j = 1
    for n in count(1):
        for m in range(n % 2, n + 1, 2):
            for _ in range(1 if m == 0 else 2):
                j += 1
                # Noll: even j are cosines, odd ones sines.
                yield n, m if j % 2 == 0 else -m


def _radial_polynomial(n: int, m: int, r: NDArray[np.float64]) -> NDArray[np.float64]:
    total = np.zeros_like(r)
    for k in range((n - m) // 2 + 1):
        denominator = factorial(k) * factorial((n + m) // 2 - k) * factorial((n - m) // 2 - k)
        total += (-1) ** k * factorial(n - k) / denominator * r ** (n - 2 * k)
    return total


def _fourier_frequencies() -> Iterator[tuple[int, int]]:
    """Pairs of whole frequencies by increasing length, without the negative of any of them."""
    max_frequency = 64
    pairs = [
        (a, b) for a in range(max_frequency) for b in range(-max_frequency, max_frequency) if a > 0 or b > 0
    ]
    yield from sorted(pairs, key=lambda f: (f[0] ** 2 + f[1] ** 2, -f[0], -f[1]))


def _fit_shapes(
    surfaces: NDArray[np.float64], pupil: NDArray[np.bool_], shapes: NDArray[np.float64], name: str
) -> NDArray[np.float64]:
    """Least-squares fit of the mirror to shapes ``(n_modes, n_pixels)``, without piston."""
    pupil_surfaces = _pupil_surfaces(surfaces, pupil)
    shapes = shapes - shapes.mean(axis=1, keepdims=True)
    m2c = np.asarray(np.linalg.lstsq(pupil_surfaces.T, shapes.T, rcond=1e-6)[0], dtype=np.float64)
    fitted_surfaces = m2c.T @ pupil_surfaces
    values = np.linalg.svd(
        fitted_surfaces / np.linalg.norm(fitted_surfaces, axis=1, keepdims=True), compute_uv=False
    )
    if len(shapes) > len(pupil_surfaces) or values[-1] < _MIN_SINGULAR_RATIO * values[0]:
        raise CalibrationError(
            f"this mirror of {len(pupil_surfaces)} actuators cannot make {len(shapes)} independent {name} "
            "modes; lower basis.n_modes, or choose basis.kind = 'kl'"
        )
    return scale_to_unit_rms(np.asarray(m2c, np.float64), surfaces, pupil)


#: Bases that depend on the influence functions only.
_BASIS_BUILDERS = {"zonal": zonal, "zernike": zernike, "fourier": fourier}


def build_modal_basis(bench: Bench) -> NDArray[np.float64]:
    """Build the mode-to-command matrix ``(n_act, n_modes)`` that the configuration asks for.

    Raises
    ------
    ConfigError
        The basis does not fit the mirror, or moves disabled actuators.
    CalibrationError
        More modes than the working actuators can make.
    """
    surfaces, pupil, pixel_m = bench.model().influence_functions()
    if surfaces.shape[0] != bench.dm.info.n_act:
        raise ConfigError(f"the model has {surfaces.shape[0]} actuators, the mirror {bench.dm.info.n_act}")
    return build_basis(bench.config, surfaces, pupil, pixel_m, bench.dm.limits.disabled)


def build_basis(
    config: SystemConfig,
    surfaces: NDArray[np.float64],
    pupil: NDArray[np.bool_],
    pixel_m: float,
    disabled: Sequence[int],
) -> NDArray[np.float64]:
    """Build a mode-to-command matrix ``(n_act, n_modes)`` with columns of unit rms surface.

    Parameters
    ----------
    surfaces, pupil, pixel_m
        Influence functions ``(n_act, n, n)`` in fractions of full stroke, the pupil ``(n, n)`` and the size
        of a pixel in metres.
    disabled
        Indices of the actuators that must not move; the modes are those of the others.

    Raises
    ------
    ConfigError
        The basis of a file has other actuators or too few modes, or moves disabled actuators.
    CalibrationError
        More modes than the working actuators can make.
    """
    basis = config.basis
    working = np.ones(surfaces.shape[0], dtype=bool)
    working[list(disabled)] = False
    if basis.kind == "file":
        # Imported here, because astropy takes a second to load.
        from escape_hw.io.fits.matrix import load_basis

        m2c = load_basis(basis.file)
        if m2c.shape[0] != surfaces.shape[0] or m2c.shape[1] < basis.n_modes:
            raise ConfigError(
                f"basis.file has {m2c.shape[0]} actuators and {m2c.shape[1]} modes; "
                f"{surfaces.shape[0]} and at least {basis.n_modes} are needed"
            )
        if m2c[~working, : basis.n_modes].any():
            raise ConfigError(
                "the modes of basis.file move actuators that devices.dm.limits.disabled keeps at zero"
            )
        return scale_to_unit_rms(m2c[:, : basis.n_modes], surfaces, pupil)
    full_m2c = np.zeros((working.size, basis.n_modes))
    if basis.kind in _BASIS_BUILDERS:
        full_m2c[working] = _BASIS_BUILDERS[basis.kind](surfaces[working], pupil, basis.n_modes)
    else:
        outer_scale_m = _OUTER_SCALE * config.system.pupil_m
        full_m2c[working] = karhunen_loeve(surfaces[working], pupil, pixel_m, basis.n_modes, outer_scale_m)
    return full_m2c
