"""Sampled pupil of a system (obscuration, Gaussian beam, contamination) and actuator positions on it, from the configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.errors import CalibrationError
from escape_hw.pipeline.geometry.obscuration import transmitted_fraction
from escape_hw.pipeline.geometry.pupil_rims import RIM_SOFTNESS

if TYPE_CHECKING:
    from escape_hw.api.pyramid import PyramidPupils
    from escape_hw.config.system import SystemConfig
    from escape_hw.config.twin import TwinContamination


#: Highest order of the smooth unevenness: waves across the pupil, or around its edge.
_MAX_WAVES = 5


def pupil_transmission(
    contamination: TwinContamination,
    diameter_m: float,
    coordinates_m: NDArray[np.float64],
    rng: np.random.Generator,
) -> NDArray[np.float64]:
    """Share of the light that each sample of a soiled pupil still passes ``(n, n)``.

    The contaminated arc passes ``transmission``. The unevenness is a sum of a few waves with random
    phases, none shorter than a fifth of the diameter; the radius of the pupil varies likewise around
    its circumference, always inwards.

    Parameters
    ----------
    dirt
        What lies on the pupil.
    diameter_m, coordinates_m
        Diameter of the pupil, and coordinates of the samples along either axis ``(n,)``, in metres.
    rng
        Of the unevenness.
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
    """A random smooth function of unit mean square; each axis is periodic over -1..1."""
    total = np.zeros_like(axes[0])
    for _ in range(4 * _MAX_WAVES):
        waves = rng.integers(-_MAX_WAVES, _MAX_WAVES + 1, len(axes))
        if not waves.any():
            waves[0] = 1
        phase = rng.uniform(0, 2 * np.pi)
        total += np.cos(sum(np.pi * k * axis for k, axis in zip(waves, axes, strict=True)) + phase)
    return np.asarray(total / np.sqrt(2 * _MAX_WAVES))


#: Pupil samples across one lenslet: alias-free to +-4 lambda/d, several times the largest tilt.
PUPIL_SAMPLES = 8
#: Pupil samples across one actuator pitch that a pyramid needs at least: a Gaussian influence function
#: keeps less than a ten-thousandth of its amplitude beyond their highest frequency.
SAMPLES_PER_PITCH = 2.0
#: Share of the design's light below which a pixel of the rim tells nothing of what dims it, ...
_MIN_RIM_LIGHT = 0.4
#: ... and the least share that a sample is left with: what the design lights counts as lit.
_MIN_TRANSMISSION = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class PupilGeometry:
    """Sampled pupil of a system.

    Parameters
    ----------
    n_sub, n_pix
        Sub-apertures across the pupil, and samples across each of them.
    sub_aperture_m
        Size of a sub-aperture in metres.
    coordinates_m
        Coordinates of the samples along either axis ``(n,)`` in metres, from the grid's centre.
    amplitude
        Amplitude ``(n, n)`` of the beam inside the round pupil, 1 at its brightest.
    """

    n_sub: int
    n_pix: int
    sub_aperture_m: float
    coordinates_m: NDArray[np.float64]
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
    """The pupil that the configuration describes: round, lit by a Gaussian beam, partly obscured.

    Parameters
    ----------
    config
        The system.
    n_pix
        Samples across a sub-aperture; as usual for the kind of sensor by default.
    """
    n_pix = n_pix or default_samples(config)
    n_sub, diameter = config.sensor.n_sub, config.system.pupil_m
    d = diameter / n_sub
    n = n_sub * n_pix
    x = (np.arange(n) - (n - 1) / 2) * d / n_pix
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    amplitude = np.where(r2 <= (diameter / 2) ** 2, np.exp(-r2 / config.sensor.beam_radius_m**2), 0.0)
    if config.telescope.obscuration or config.telescope.spiders_deg:
        # A sample that is covered in part keeps its share of the light, not of the amplitude.
        amplitude *= np.sqrt(transmitted_fraction(config.telescope, diameter, x))
    return PupilGeometry(n_sub, n_pix, d, x, amplitude.astype(np.float32))


def pupil_from_images(config: SystemConfig, pupils: PyramidPupils) -> PupilGeometry:
    """The pupil that a pyramid's images show.

    On a telescope it is lit as they say, for what lies on its mirrors dims parts of it; a bench's beam
    is taken for the design's.

    Raises
    ------
    CalibrationError
        The images have another size than the design's.
    """
    pupil = pupil_geometry(config)
    if pupils.valid.shape != (pupil.n_sub, pupil.n_sub):
        raise CalibrationError(
            f"the pupil images have {pupils.valid.shape} pixels; sensor.n_sub is {pupil.n_sub}"
        )
    return apply_measured_illumination(pupil, pupils) if config.telescope.obscuration else pupil


def apply_measured_illumination(pupil: PupilGeometry, pupils: PyramidPupils) -> PupilGeometry:
    """A pupil, brightened or dimmed by the light of its images relative to the design's."""
    n, p = pupil.n_sub, pupil.n_pix
    design = ndimage.gaussian_filter(np.square(pupil.amplitude, dtype=float), RIM_SOFTNESS * p)
    # Boxes lie a fraction of a pixel beside their images.
    offset_px = pupils.corners_px + (n - 1) / 2 - pupils.centres_px
    shifted = [ndimage.shift(design, (-y * p, -x * p), order=1) for x, y in offset_px]
    expected = np.mean(shifted, axis=0).reshape(n, p, n, p).sum(axis=(1, 3))
    usable = expected > _MIN_RIM_LIGHT * expected.max()
    share = np.where(usable, pupils.flux / np.where(usable, expected, 1.0), 0.0)
    # Beyond the last pixel that tells, the nearest one does.
    share = share[tuple(ndimage.distance_transform_edt(~usable, return_indices=True)[1])]
    sample_px = (np.arange(n * p) + 0.5) / p - 0.5
    x, y = offset_px.mean(axis=0)
    at_samples = np.meshgrid(sample_px - y, sample_px - x, indexing="ij")
    relative_transmission = ndimage.map_coordinates(
        share / np.percentile(share, 95), at_samples, order=1, mode="nearest"
    )
    amplitude = pupil.amplitude * np.sqrt(np.maximum(relative_transmission, _MIN_TRANSMISSION))
    return replace(pupil, amplitude=amplitude.astype(np.float32))


def default_samples(config: SystemConfig) -> int:
    """Pupil samples across a sub-aperture: as many as the mirror or the lenslets ask for.

    A pyramid's sub-aperture is a pixel of the pupil image, which may be wider than an actuator pitch.
    """
    if config.sensor.kind != "pyramid":
        return PUPIL_SAMPLES
    least = SAMPLES_PER_PITCH * config.devices.dm.pitches_across_pupil / config.sensor.n_sub
    return max(1, math.ceil(least))


def contaminated_pupil(config: SystemConfig, rng: np.random.Generator) -> PupilGeometry:
    """The pupil of the twin, with whatever ``twin.contamination`` puts on it."""
    pupil, contamination = pupil_geometry(config), config.twin.contamination
    share = pupil_transmission(contamination, config.system.pupil_m, pupil.coordinates_m, rng)
    return replace(pupil, amplitude=(pupil.amplitude * np.sqrt(share)).astype(np.float32))


def actuator_positions(config: SystemConfig) -> NDArray[np.float64]:
    """Actuator positions ``(n_act, 2)`` as (x, y) in metres on the pupil."""
    return config.devices.dm.positions() * pitch_on_pupil(config)


def pitch_on_pupil(config: SystemConfig) -> float:
    """Actuator pitch in metres, as relayed onto the pupil."""
    return config.system.pupil_m / config.devices.dm.pitches_across_pupil
