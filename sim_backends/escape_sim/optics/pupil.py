"""Sampled pupil of a system: obscuration, Gaussian beam, contamination."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.config.twin import TwinBeam
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.geometry.obscuration import transmitted_fraction
from escape_hw.pipeline.geometry.pupil_rims import RIM_SOFTNESS

if TYPE_CHECKING:
    from escape_hw.api.pyramid import PyramidPupils
    from escape_hw.api.sensor import SubApertureGrid
    from escape_hw.config.system import SystemConfig
    from escape_hw.config.twin import TwinContamination


#: Highest order of the smooth unevenness: waves across the pupil or around its edge.
_MAX_WAVES = 5


def pupil_transmission(
    contamination: TwinContamination,
    diameter_m: float,
    coordinates_m: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Transmission ``(n, n)`` of a contaminated pupil.

    The contaminated arc transmits ``contamination.transmission``. The unevenness is a sum of random
    waves, none shorter than a fifth of the diameter. The radius of the pupil varies likewise around its
    circumference, always inwards. ``coordinates_m (n,)`` are those of the samples along either axis.
    """
    u = coordinates_m / (diameter_m / 2)
    x, y = np.meshgrid(u, u)
    radius, angle = np.hypot(x, y), np.arctan2(y, x)
    transmission_map = _random_smooth_map(rng, (x, y))
    radius_map = _random_smooth_map(rng, (angle / np.pi,))
    share = np.clip(1 + contamination.unevenness * transmission_map, 0, None)
    arc_distance = np.abs((angle - np.deg2rad(contamination.angle_deg) + np.pi) % (2 * np.pi) - np.pi)
    arc = (arc_distance <= np.pi * contamination.edge_share) & (radius > 1 - contamination.depth)
    if contamination.edge_share:
        share[arc] *= contamination.transmission
    if contamination.edge_unevenness:
        share[radius > 1 - contamination.edge_unevenness * np.abs(radius_map)] = 0.0
    return np.asarray(share)


def _random_smooth_map(
    rng: np.random.Generator, axes: tuple[NDArray[np.float64], ...]
) -> NDArray[np.float64]:
    """Draw a smooth function of unit mean square; each axis is periodic over -1..1."""
    total = np.zeros_like(axes[0])
    for _ in range(4 * _MAX_WAVES):
        waves = rng.integers(-_MAX_WAVES, _MAX_WAVES + 1, len(axes))
        if not waves.any():
            waves[0] = 1
        phase = rng.uniform(0, 2 * np.pi)
        total += np.cos(sum(np.pi * k * axis for k, axis in zip(waves, axes, strict=True)) + phase)
    return np.asarray(total / np.sqrt(2 * _MAX_WAVES))


#: Pupil samples across a lenslet: alias-free to +-4 lambda/d, several times the largest tilt.
PUPIL_SAMPLES = 8
#: Least pupil samples across an actuator pitch for a pyramid: beyond their Nyquist frequency a Gaussian
#: influence function has less than a ten-thousandth of its amplitude.
SAMPLES_PER_PITCH = 2.0
#: Pixels of the rim with less than this share of the largest design flux do not measure transmission.
_MIN_RIM_LIGHT = 0.4
#: Least number of fully lit lenslets whose light shows the beam.
_MIN_LENSLETS = 20
#: Rounds of the fit to their light, and deviation in units of the median one above which one is left out.
_OUTLIER_ROUNDS, _OUTLIER = 4, 5.0
#: Smallest transmission of a sample that the design illuminates; it stays lit.
_MIN_TRANSMISSION = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class PupilGeometry:
    """Sampled pupil of a system."""

    #: Sub-apertures across the grid, and samples across each of them.
    n_sub: int
    n_pix: int
    sub_aperture_m: float
    #: Coordinates of the samples along either axis ``(n,)`` in metres, from the grid's centre.
    coordinates_m: NDArray[np.float64]
    #: Amplitude ``(n, n)`` of the beam inside the round pupil, 1 at its maximum.
    amplitude: NDArray[np.float32]

    @property
    def pixel_m(self) -> float:
        """Size of a sample in metres."""
        return self.sub_aperture_m / self.n_pix

    @property
    def lit(self) -> NDArray[np.bool_]:
        """Samples that carry light ``(n, n)``."""
        return np.asarray(self.amplitude > 0)


def pupil_geometry(config: SystemConfig, n_pix: int | None = None) -> PupilGeometry:
    """Nominal pupil of a system: round, Gaussian illumination, with its obscuration.

    ``n_pix`` is the number of samples across a sub-aperture, by default :func:`default_samples`.
    """
    return _sampled_pupil(config, n_pix or default_samples(config), TwinBeam(), None)


def true_pupil(config: SystemConfig) -> PupilGeometry:
    """Pupil of the twin, with the true beam and size of the pupil images, without contamination.

    The sub-aperture of a pyramid is a camera pixel. Where the images have another diameter than the nominal
    one, ``n_sub`` pixels are at least as wide.
    """
    return _sampled_pupil(config, default_samples(config), config.twin.beam, config.twin.pyramid.diameter_px)


def true_diameter(config: SystemConfig) -> float:
    """True diameter of the pupil in sub-apertures; for a pyramid, that of its images in pixels."""
    return float(config.twin.pyramid.diameter_px or config.sensor.n_sub)


def _sampled_pupil(
    config: SystemConfig, n_pix: int, beam: TwinBeam, diameter_px: float | None
) -> PupilGeometry:
    """Round pupil with a Gaussian beam; ``diameter_px`` sub-apertures across, by default ``sensor.n_sub``."""
    n_sub, diameter = config.sensor.n_sub, config.system.pupil_m
    if diameter_px is not None:
        n_sub = 2 * math.ceil(diameter_px / 2)
    d = diameter / (diameter_px or n_sub)
    n = n_sub * n_pix
    x = (np.arange(n) - (n - 1) / 2) * d / n_pix
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    beam_r2 = r2
    if any(beam.centre_m):
        beam_r2 = (x[:, None] - beam.centre_m[1]) ** 2 + (x[None, :] - beam.centre_m[0]) ** 2
    radius = beam.radius_m or config.sensor.beam_radius_m
    amplitude = np.where(r2 <= (diameter / 2) ** 2, np.exp(-beam_r2 / radius**2), 0.0)
    if config.telescope.obscuration or config.telescope.spiders_deg:
        # A partly covered sample keeps that share of the light, not of the amplitude.
        amplitude *= np.sqrt(transmitted_fraction(config.telescope, diameter, x))
    return PupilGeometry(n_sub, n_pix, d, x, amplitude.astype(np.float32))


def nominal_flux(config: SystemConfig) -> NDArray[np.float64]:
    """Flux ``(n_sub, n_sub)`` of the design's sub-apertures, 1 for a bright one."""
    pupil = pupil_geometry(config)
    n, p = pupil.n_sub, pupil.n_pix
    flux = np.square(pupil.amplitude, dtype=float).reshape(n, p, n, p).sum(axis=(1, 3))
    return np.asarray(flux / np.percentile(flux[flux > 0], 95))


def pupil_from_images(config: SystemConfig, pupils: PyramidPupils) -> PupilGeometry:
    """Pupil with the illumination of measured pyramid images.

    On a telescope the images' flux sets the illumination, which contamination changes; on a bench it
    is the design's.

    Raises
    ------
    CalibrationError
        The images have another size than the design's.
    """
    pupil = pupil_geometry(config)
    if pupils.valid.shape != (pupil.n_sub, pupil.n_sub):
        raise CalibrationError(
            f"the pupil images have {pupils.valid.shape} pixels; sensor.n_sub is {pupil.n_sub}; "
            "calibrate the pupil images again or correct sensor.n_sub"
        )
    return apply_measured_illumination(pupil, pupils) if config.telescope.obscuration else pupil


def apply_measured_illumination(pupil: PupilGeometry, pupils: PyramidPupils) -> PupilGeometry:
    """Multiply a pupil's illumination by the ratio of measured to nominal flux of its images."""
    n, p = pupil.n_sub, pupil.n_pix
    design = ndimage.gaussian_filter(np.square(pupil.amplitude, dtype=float), RIM_SOFTNESS * p)
    # The boxes are aligned to pixels, the images are not.
    offset_px = pupils.corners_px + (n - 1) / 2 - pupils.centres_px
    shifted = [ndimage.shift(design, (-y * p, -x * p), order=1) for x, y in offset_px]
    expected = np.mean(shifted, axis=0).reshape(n, p, n, p).sum(axis=(1, 3))
    usable = expected > _MIN_RIM_LIGHT * expected.max()
    share = np.where(usable, pupils.flux / np.where(usable, expected, 1.0), 0.0)
    # Extrapolate from the nearest usable pixel.
    share = share[tuple(ndimage.distance_transform_edt(~usable, return_indices=True)[1])]
    sample_px = (np.arange(n * p) + 0.5) / p - 0.5
    x, y = offset_px.mean(axis=0)
    at_samples = np.meshgrid(sample_px - y, sample_px - x, indexing="ij")
    relative_transmission = ndimage.map_coordinates(
        share / np.percentile(share, 95), at_samples, order=1, mode="nearest"
    )
    amplitude = pupil.amplitude * np.sqrt(np.maximum(relative_transmission, _MIN_TRANSMISSION))
    return replace(pupil, amplitude=amplitude.astype(np.float32))


def pupil_from_lenslets(config: SystemConfig, grid: SubApertureGrid) -> PupilGeometry:
    """Pupil with the beam that the light of the lenslets shows; the nominal one where that is not known.

    Where a lenslet is brighter on one side, its slope is that of a place on that side. A beam that is
    narrower than described hence moves the scalings of a registration, and one off centre the shifts. The
    logarithm of measured over nominal light is fitted by a polynomial of second degree, which is exact for
    Gaussian beams of any width and place.
    """
    pupil = pupil_geometry(config)
    n, p = pupil.n_sub, pupil.n_pix
    if not grid.counts or grid.flux.shape != (n, n):
        return pupil
    expected = np.square(pupil.amplitude, dtype=float).reshape(n, p, n, p).sum(axis=(1, 3))
    whole = pupil.lit.reshape(n, p, n, p).all(axis=(1, 3))
    usable = whole & grid.valid & (grid.flux > 0)
    if usable.sum() < _MIN_LENSLETS:
        return pupil
    rows, columns = np.nonzero(usable)
    x, y = (np.asarray((at - (n - 1) / 2) / (n / 2), float) for at in (columns, rows))
    ratio = np.log(grid.flux[usable] / expected[usable])
    coefficients = _fit_without_outliers(_quadratic(x, y), ratio)
    u = pupil.coordinates_m / (n * pupil.sub_aperture_m / 2)
    relative = np.tensordot(coefficients[1:], _quadratic(*np.meshgrid(u, u))[1:], axes=1)
    amplitude = pupil.amplitude * np.exp(relative / 2)
    return replace(pupil, amplitude=(amplitude / amplitude.max()).astype(np.float32))


def _quadratic(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """Monomials to the second degree ``(6, ...)``, the constant first."""
    return np.stack([np.ones_like(x), x, y, x * x, x * y, y * y])


def _fit_without_outliers(basis: NDArray[np.float64], values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Coefficients ``(k,)`` of ``basis (k, n)`` for ``values (n,)``, without dirty or broken lenslets."""
    used = np.ones(values.size, bool)
    coefficients: NDArray[np.float64] = np.zeros(len(basis))
    for _ in range(_OUTLIER_ROUNDS):
        coefficients = np.asarray(np.linalg.lstsq(basis[:, used].T, values[used])[0], float)
        away = np.abs(values - coefficients @ basis)
        used = away <= _OUTLIER * max(float(np.median(away)), 1e-12)
    return coefficients


def default_samples(config: SystemConfig) -> int:
    """Pupil samples across a sub-aperture.

    For a pyramid, whose sub-aperture (a pixel of the pupil image) may be wider than an actuator pitch,
    as many as the mirror's pitch requires.
    """
    if config.sensor.kind != "pyramid":
        return PUPIL_SAMPLES
    required = SAMPLES_PER_PITCH * config.devices.dm.pitches_across_pupil / config.sensor.n_sub
    return max(1, math.ceil(required))


def contaminated_pupil(config: SystemConfig, rng: np.random.Generator) -> PupilGeometry:
    """True pupil of the twin, with ``twin.contamination``."""
    pupil, contamination = true_pupil(config), config.twin.contamination
    share = pupil_transmission(contamination, config.system.pupil_m, pupil.coordinates_m, rng)
    return replace(pupil, amplitude=(pupil.amplitude * np.sqrt(share)).astype(np.float32))
