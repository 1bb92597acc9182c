"""Finds the pupil among the lenslets of a Shack-Hartmann sensor, from the light on each.

The pupil ends where the light of a lenslet drops relative to its neighbours. A beam beside the centre of the
pupil, or one that is narrower than the pupil, falls off gradually, and its brightness says nothing about the
edge. So a round pupil in light whose logarithm is a polynomial of second order, as that of any Gaussian beam
is, is fitted to the light on the lenslets, and the residuals are relative to the neighbours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, optimize

from escape_hw.pipeline.slopes.shack_hartmann import subaperture_windows

#: Points along each side of a lenslet on which its lit part is computed.
_POINTS = 4
#: Share of the brightest neighbour's light below which a lenslet counts as dark. A window receives a few
#: hundredths from the lenslets around it by diffraction.
_DARK_SHARE = 0.1
#: Light that counts as darkness, relative to a bright lenslet: at least what many lenslets together scatter,
#: and a percentile, where a round pupil leaves a fifth of its square dark.
_LEAST_LIGHT, _DARK_PERCENTILE = 0.02, 10.0
#: Noise of the dark lenslets, in units of the first percentile of all, which is about -2 standard errors.
_NOISE = 2.0
#: Share of the pupil's radius that is left out, where an obscuration may be.
_INNER_SHARE = 0.5
#: Standard error of the radius in lenslets: half of the rounding of the diameter to whole lenslets.
_RADIUS_SIGMA = 0.25
#: Starts of the fit around the middle of the light, in lenslets.
_STARTS = ((0, 0), (2, 0), (-2, 0), (0, 2), (0, -2))
#: Least deviation: where hardly any lenslet outside the inner part is lit, all agree with a dark model.
_LEAST_RMS = 0.1
#: Deviation assumed in the first fit, and standard errors within which the centre is assumed to be.
_FIRST_RMS, _N_SIGMA = 0.1, 3.0
#: Deviation of a lenslet that is lit but dark in the model, or dark but lit.
_CONTRADICTION = 0.5
#: Part of a pitch between the centre of a lenslet and the border of the camera region, at least.
_BORDER = 0.3


@dataclass(frozen=True, slots=True, eq=False)
class LensletLight:
    """Light on all lenslets in the camera region.

    Parameters
    ----------
    flux
        ``(n_rows, n_columns)``, relative to a bright one; negative by noise where there is no light.
    first
        Column and row of the first one on the lattice.
    """

    flux: NDArray[np.float64]
    first: tuple[int, int]

    @classmethod
    def from_image(
        cls, image: NDArray[np.float64], pitch: float, origin: tuple[float, float]
    ) -> LensletLight:
        """Sum the light around the points of a lattice, which extends to all sides."""
        sides = []
        for start, size in zip(origin, image.shape[::-1], strict=True):
            low, high = _BORDER - start / pitch, (size - 1 - start) / pitch - _BORDER
            sides.append(np.arange(math.ceil(low), math.floor(high) + 1))
        columns, rows = sides
        places = np.meshgrid(origin[0] + columns * pitch, origin[1] + rows * pitch)
        centres = np.stack([place.ravel() for place in places], axis=1)
        top, end, left, right = subaperture_windows(centres, pitch, (image.shape[0], image.shape[1])).T
        area = np.pad(image.cumsum(0).cumsum(1), ((1, 0), (1, 0)))
        flux = area[end, right] - area[top, right] - area[end, left] + area[top, left]
        flux = flux.reshape(rows.size, columns.size)
        return cls(flux / max(float(np.percentile(flux, 99)), 1e-12), (int(columns[0]), int(rows[0])))


@dataclass(frozen=True, slots=True)
class PupilOutline:
    """Centre of the pupil on the lattice.

    Parameters
    ----------
    centre
        Column and row; not whole numbers.
    error
        Largest error of either.
    """

    centre: tuple[float, float]
    error: tuple[float, float]

    def first_lenslet(self, n_sub: int) -> tuple[int, int]:
        """Column and row of the first lenslet of a grid centred on the pupil."""
        x, y = (round(at - (n_sub - 1) / 2) for at in self.centre)
        return x, y

    def competing_offsets(self, n_sub: int) -> tuple[tuple[int, int], tuple[int, int]]:
        """Least and largest offset of this numbering's competitors along x and along y; 0: none."""
        offsets = []
        for at, first, error in zip(self.centre, self.first_lenslet(n_sub), self.error, strict=True):
            off = at - (n_sub - 1) / 2 - first
            least, largest = (min(math.floor(error + side + 0.5), n_sub // 2) for side in (-off, off))
            offsets.append((-max(least, 0), max(largest, 0)))
        return offsets[0], offsets[1]


def fit_pupil_outline(light: LensletLight, n_sub: int, start: tuple[float, float]) -> PupilOutline:
    """Fit a round pupil of about ``n_sub`` lenslets to the light on the lenslets.

    The error of the centre is three standard errors plus what a difference between the fitted and the nominal
    radius tells of the rim. A part of the rim at ``r(phi)`` instead of the radius ``R`` changes the fitted
    radius by the mean of ``r - R`` and the centre by twice the mean of ``(r - R) cos(phi)``, where part of
    the rim is dark by up to twice as much. Of this, half a lenslet does not change the numbering. ``N``
    lenslets that contradict the fit are an area that may likewise move the centre by ``N / (pi R)``.

    Parameters
    ----------
    start
        Approximate centre, column and row.
    """
    radius = n_sub / 2
    fit = _RoundPupil(light, radius)
    # Starts around the given one: from far away the fit may end in a local minimum.
    first = min(
        (fit.solve((start[0] + x, start[1] + y, radius), _FIRST_RMS) for x, y in _STARTS),
        key=lambda one: one.rms,
    )
    found = fit.solve(first.parameters[:3], max(first.rms, _LEAST_RMS))
    off = abs(float(found.parameters[2]) - radius)
    contradicted = int((np.abs(found.deviations) > _CONTRADICTION).sum())
    error = _N_SIGMA * found.sigma + max(off, 2 * off - 0.5) + contradicted / (math.pi * radius)
    x, y = found.parameters[:2].tolist()
    return PupilOutline((x, y), (float(error[0]), float(error[1])))


@dataclass(frozen=True, slots=True, eq=False)
class _Solution:
    """Parameters, centre and radius first; standard errors of the centre; deviations of the lenslets."""

    parameters: NDArray[np.float64]
    sigma: NDArray[np.float64]
    deviations: NDArray[np.float64]

    @property
    def rms(self) -> float:
        """Rms deviation."""
        degrees = max(self.deviations.size - self.parameters.size, 1)
        return float(np.sqrt(np.square(self.deviations).sum() / degrees))


class _RoundPupil:
    """Least-squares fit of centre, radius and the six coefficients of the logarithm of the beam."""

    def __init__(self, light: LensletLight, nominal_radius: float) -> None:
        self._flux, self._radius = np.maximum(light.flux, 0.0), nominal_radius
        (n_rows, n_columns), (column, row) = light.flux.shape, light.first
        self._columns, self._rows = column + np.arange(n_columns), row + np.arange(n_rows)
        lowest, dark = np.percentile(light.flux, (1.0, _DARK_PERCENTILE))
        self._dark = max(float(dark), -_NOISE * float(lowest), _LEAST_LIGHT)
        self._scale = self._dark + _DARK_SHARE * ndimage.maximum_filter(self._flux, 3)

    def solve(self, start: tuple[float, ...] | NDArray[np.float64], rms: float) -> _Solution:
        """Fit from a centre and radius, with deviations of an expected ``rms``."""
        used, terms = self._outer_part(start)
        bright = used & (self._flux > 3 * self._dark)
        beam = np.linalg.lstsq(terms[bright], np.log(self._flux[bright]), rcond=None)[0]

        def residuals(parameters: NDArray[np.float64]) -> NDArray[np.float64]:
            # A centre that no light on the rim determines is anywhere in the pupil.
            anywhere = (parameters[:2] - start[:2]) / self._radius
            prior = [*anywhere, (parameters[2] - self._radius) / _RADIUS_SIGMA]
            return np.append(self._deviations(parameters, used, terms) / rms, prior)

        solution = optimize.least_squares(residuals, np.concatenate([start, beam]))
        covariance = np.linalg.pinv(solution.jac.T @ solution.jac, hermitian=True)
        return _Solution(solution.x, np.sqrt(np.diag(covariance)[:2]), solution.fun[:-3] * rms)

    def _outer_part(
        self, centre: tuple[float, ...] | NDArray[np.float64]
    ) -> tuple[NDArray[np.bool_], NDArray[np.float64]]:
        """Lenslets that are used, and the terms of the polynomial ``(n_rows, n_columns, 6)``."""
        x, y = np.meshgrid(
            (self._columns - centre[0]) / self._radius, (self._rows - centre[1]) / self._radius
        )
        terms = np.stack([np.ones_like(x), x, y, x * x, x * y, y * y], axis=-1)
        return np.hypot(x, y) > _INNER_SHARE, terms

    def _deviations(
        self, parameters: NDArray[np.float64], used: NDArray[np.bool_], terms: NDArray[np.float64]
    ) -> NDArray[np.float64]:
        """Flux minus model, from -1 to 1: lit in the model only, or on the sensor only."""
        model = np.exp(np.minimum(terms @ parameters[3:], 5.0)) * self._lit_part(*parameters[:3])
        return np.asarray(((self._flux - model) / (self._flux + model + self._scale))[used])

    def _lit_part(self, x: float, y: float, radius: float) -> NDArray[np.float64]:
        """Part of every lenslet that lies within a circle."""
        inner = (np.arange(_POINTS) - (_POINTS - 1) / 2) / _POINTS
        dx, dy = (
            (at[:, None] + inner).ravel() - centre for at, centre in ((self._columns, x), (self._rows, y))
        )
        # An edge as wide as the points are apart makes the part a smooth function of the circle.
        points = np.clip((radius - np.hypot(dx, dy[:, None])) * _POINTS + 0.5, 0.0, 1.0)
        return np.asarray(points.reshape(self._rows.size, _POINTS, -1, _POINTS).mean(axis=(1, 3)))
