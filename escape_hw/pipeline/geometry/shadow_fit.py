"""Offset of the secondary mirror's shadow in four unevenly lit pupil images."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import linalg, ndimage

from escape_hw.pipeline.geometry.obscuration import Shadow
from escape_hw.pipeline.geometry.pupil_rims import RIM_SOFTNESS

#: Share of the radius in which the shadow is fitted: away from the rim, where contamination collects.
_FIT_RADIUS = 0.6
#: Larger images are binned: the time of a fit increases with the sixth power of the diameter.
_MAX_DIAMETER_PX = 40.0
#: Number of iterations, and largest step of each in pixels.
_ITERATIONS, _MAX_STEP = 4, 0.7
#: Samples across a pixel of the shadow map (odd).
_OVERSAMPLING = 21
#: Relative change of the softness for which the change of the shadow is computed.
_SOFTNESS_CHANGE = 0.1
#: Scales of the unevenness to start from, see :class:`_Unevenness`.
_START = np.log([1.0, 2.0, 1.0, 2.0])
#: Evaluations and tolerances (parameters, log likelihood) of the search for the unevenness: a likelihood that
#: changes by less than a factor of e is not significant.
_SEARCH = {"maxfev": 120, "xatol": 0.3, "fatol": 1.0}


@dataclass(frozen=True, slots=True, eq=False)
class _Pixels:
    """Pixels ``(n,)`` of the four images: position from the centre of their image, light, and image."""

    x: NDArray[np.float64]
    y: NDArray[np.float64]
    light: NDArray[np.float64]
    number: NDArray[np.intp]


@dataclass(frozen=True, slots=True, eq=False)
class _LinearModel:
    """Residual ``(n,)`` of the relative light, its derivatives ``(n, p)`` (the offset last), transmission."""

    residual: NDArray[np.float64]
    terms: NDArray[np.float64]
    transmission: NDArray[np.float64]


def fit_shadow_offset(
    image: NDArray[np.float64], centres: NDArray[np.float64], diameter: float, shadow: Shadow
) -> tuple[NDArray[np.float64], float]:
    """Fit the common offset of the shadow from the centres of the images.

    The light of an image is its level times the transmission times ``1 + unevenness``, plus white noise. The
    unevenness is a Gaussian process with two parts: one that the images share, as contamination does, and one
    that cancels in their sum, because turbulence moves light from one image to another. Strength and
    correlation length of either, and the noise, are those under which the image is most likely, so the
    standard error follows from the image itself.

    Parameters
    ----------
    image
        Light ``(rows, columns)``, background subtracted.
    centres
        Centres of the images ``(4, 2)`` as (x, y).
    diameter
        Their diameter in pixels.
    shadow
        Transmission from :func:`~escape_hw.pipeline.geometry.obscuration.build_shadow`.

    Returns
    -------
    offset : ndarray, ``(2,)``
        As (x, y) in pixels.
    sigma : float
        Standard error along an axis.
    """
    binning = math.ceil(diameter / _MAX_DIAMETER_PX)
    if binning > 1:
        at = (centres + 0.5) / binning - 0.5
        offset, sigma = _fit_offset(
            _bin(image, binning), at, diameter / binning, shadow, RIM_SOFTNESS / binning
        )
        return binning * offset, binning * sigma
    return _fit_offset(image, centres, diameter, shadow, RIM_SOFTNESS)


def _bin(image: NDArray[np.float64], binning: int) -> NDArray[np.float64]:
    """Sums of blocks of pixels; an incomplete block at the end is padded."""
    missing = [(0, -length % binning) for length in image.shape]
    rows, columns = (length + pad for length, (_, pad) in zip(image.shape, missing, strict=True))
    blocks = np.pad(image, missing).reshape(rows // binning, binning, columns // binning, binning)
    return np.asarray(blocks.sum(axis=(1, 3)))


def _fit_offset(
    image: NDArray[np.float64],
    centres: NDArray[np.float64],
    diameter: float,
    shadow: Shadow,
    softness: float,
) -> tuple[NDArray[np.float64], float]:
    pixels = _select_pixels(image, centres, diameter)
    unevenness, scales = _Unevenness(pixels), _START
    offset, covariance = np.zeros(2), np.zeros((2, 2))
    for iteration in range(_ITERATIONS):
        model = _linearise(pixels, _shadow_map(shadow, diameter, softness), offset)
        if iteration == _ITERATIONS // 2:
            # What a wrong offset, softness and size leave would otherwise count as unevenness.
            scales = unevenness.find_scales(model)
        changes, step, covariance = unevenness.fit(model, scales)
        offset = offset + np.clip(step, -_MAX_STEP, _MAX_STEP)
        softness *= float(np.clip(1 + changes[0], 0.7, 1.4))
        diameter *= float(np.clip(1 + changes[1], 0.9, 1.1))
    return offset, float(np.sqrt(np.trace(covariance) / 2))


def _select_pixels(image: NDArray[np.float64], centres: NDArray[np.float64], diameter: float) -> _Pixels:
    """Pixels around the shadow."""
    columns, rows = np.meshgrid(*(np.arange(length) for length in image.shape[::-1]))
    parts = []
    for number, (cx, cy) in enumerate(centres):
        inside = np.hypot(columns - cx, rows - cy) < _FIT_RADIUS * diameter / 2
        numbers = np.full(inside.sum(), number)
        parts.append((columns[inside] - cx, rows[inside] - cy, image[inside], numbers))
    x, y, light, number_of = (np.concatenate(part) for part in zip(*parts, strict=True))
    return _Pixels(x, y, light, number_of)


def _shadow_map(shadow: Shadow, diameter: float, softness: float) -> NDArray[np.float64]:
    """Map ``(5, n, n)`` of the light that a pixel loses, and of its derivatives.

    The derivatives are those with respect to relative changes of softness and size, and to the offset (x, y).
    As a function of the position of the pixel from the shadow's centre, with :data:`_OVERSAMPLING` samples
    per pixel.
    """
    half = (math.ceil(_FIT_RADIUS * diameter / 2) + 2) * _OVERSAMPLING
    at = np.arange(-half, half + 1) / (_OVERSAMPLING * diameter)
    covered = ndimage.uniform_filter(1 - shadow(at, at), _OVERSAMPLING, mode="nearest")
    seen, softer = (
        ndimage.gaussian_filter(covered, softness * change * _OVERSAMPLING, mode="nearest")
        for change in (1, 1 + _SOFTNESS_CHANGE)
    )
    by_y, by_x = np.gradient(seen, 1 / _OVERSAMPLING)
    px = at * diameter
    larger = -(by_x * px + by_y * px[:, None])
    return np.stack([seen, (softer - seen) / _SOFTNESS_CHANGE, larger, -by_x, -by_y])


def _linearise(pixels: _Pixels, shadow_map: NDArray[np.float64], offset: NDArray[np.float64]) -> _LinearModel:
    """Linearise the model of the relative light about an offset.

    The unknowns are the level and the light within the shadow of each image, and softness, size and offset of
    the shadow. A wrong size in uneven light would be taken for an offset.
    """
    places = np.stack([pixels.y - offset[1], pixels.x - offset[0]]) * _OVERSAMPLING + shadow_map.shape[1] // 2
    dark, *moving = (ndimage.map_coordinates(part, places, order=1) for part in shadow_map)
    transmission = 1 - dark
    images = pixels.number[:, None] == np.arange(4)
    lit = images * transmission[:, None]
    levels = pixels.light @ lit / np.square(lit).sum(axis=0)
    relative = pixels.light / levels[pixels.number]
    terms = np.column_stack([lit, images * dark[:, None], *(-part for part in moving)])
    return _LinearModel(relative - transmission, terms, transmission)


class _Unevenness:
    """Gaussian process of the uneven light on the pixels of the four images.

    Its scales are the logarithms of strength relative to the noise and length in pixels, of the part that
    the images share and of the part that cancels in their sum.
    """

    def __init__(self, pixels: _Pixels) -> None:
        x, y, number = pixels.x, pixels.y, pixels.number
        self._square_distance = np.square(x[:, None] - x) + np.square(y[:, None] - y)
        # Projects onto the differences between the images.
        self._differences = (number[:, None] == number) - 0.25

    def find_scales(self, model: _LinearModel) -> NDArray[np.float64]:
        """Scales ``(4,)`` of the largest restricted likelihood."""
        # Half a second, which a Shack-Hartmann sensor need not wait for.
        from scipy import optimize

        limits = np.log([(1e-3, 1e3), (0.5, 50.0)] * 2)
        simplex = np.vstack([_START, _START + 0.7 * np.eye(4)])
        found = optimize.minimize(
            lambda scales: self._solve(model, scales)[2], _START, method="Nelder-Mead", bounds=limits,
            options={**_SEARCH, "initial_simplex": simplex},
        )  # fmt: skip
        return np.asarray(found.x)

    def fit(
        self, model: _LinearModel, scales: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Generalised least squares: softness and size ``(2,)``, offset ``(2,)``, its covariance."""
        solution, covariance, _ = self._solve(model, scales)
        return solution[-4:-2], solution[-2:], covariance[-2:, -2:]

    def _solve(
        self, model: _LinearModel, scales: NDArray[np.float64]
    ) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
        """Solution, covariance, and negative logarithm of the restricted likelihood."""
        factor = linalg.cholesky(
            self._covariance(model, scales), lower=True, overwrite_a=True, check_finite=False
        )
        both = np.column_stack([model.terms, model.residual])
        white = linalg.solve_triangular(factor, both, lower=True, check_finite=False)
        terms, residual = white[:, :-1], white[:, -1]
        normal = terms.T @ terms
        solution = np.linalg.solve(normal, terms.T @ residual)
        freedom = terms.shape[0] - terms.shape[1]
        # Variance of the noise, relative to which the strengths are.
        noise = float(np.sum(np.square(residual - terms @ solution))) / freedom
        determinants = np.log(np.diag(factor)).sum() + np.linalg.slogdet(normal)[1] / 2
        return solution, noise * np.linalg.inv(normal), float(determinants + freedom / 2 * np.log(noise))

    def _covariance(self, model: _LinearModel, scales: NDArray[np.float64]) -> NDArray[np.float64]:
        """Covariance of the relative light ``(n, n)`` in units of the noise's variance."""
        strength, length, strength_apart, length_apart = np.exp(scales)
        total = strength**2 * np.exp(self._square_distance / (-2 * length**2))
        total += self._differences * (
            strength_apart**2 * np.exp(self._square_distance / (-2 * length_apart**2))
        )
        # There is no unevenness where there is no light.
        total *= model.transmission[:, None] * model.transmission
        total[np.diag_indices_from(total)] += 1
        return np.asarray(total)
