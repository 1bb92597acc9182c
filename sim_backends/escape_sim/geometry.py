"""Design geometry shared by the twin and by the synthetic model, both built from the configuration."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_hw.errors import CalibrationError
from escape_hw.pipeline.obscuration import passed_share
from escape_hw.pipeline.rims import SOFT
from escape_sim.telescope_pupil import soiled_share

if TYPE_CHECKING:
    from escape_hw.api.pyramid import PyramidPupils
    from escape_hw.config.models import SystemConfig

#: Pupil samples across one lenslet: alias-free to +-4 lambda/d, several times the largest tilt.
PUPIL_SAMPLES = 8
#: Pupil samples across one actuator pitch that a pyramid needs at least: a Gaussian influence function
#: keeps less than a ten-thousandth of its amplitude beyond their highest frequency.
SAMPLES_PER_PITCH = 2.0
#: Share of the design's light below which a pixel of the rim tells nothing of what dims it, ...
_TELLING = 0.4
#: ... and the least share that a sample is left with: what the design lights counts as lit.
_DIMMEST = 1e-3


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
    n_pix = n_pix or usual_samples(config)
    n_sub, diameter = config.sensor.n_sub, config.system.pupil_m
    d = diameter / n_sub
    n = n_sub * n_pix
    x = (np.arange(n) - (n - 1) / 2) * d / n_pix
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    amplitude = np.where(r2 <= (diameter / 2) ** 2, np.exp(-r2 / config.sensor.beam_radius_m**2), 0.0)
    if config.telescope.obscuration or config.telescope.spiders_deg:
        # A sample that is covered in part keeps its share of the light, not of the amplitude.
        amplitude *= np.sqrt(passed_share(config.telescope, diameter, x))
    return PupilGeometry(n_sub, n_pix, d, x, amplitude.astype(np.float32))


def pupil_of_images(config: SystemConfig, pupils: PyramidPupils) -> PupilGeometry:
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
    return lit_as_seen(pupil, pupils) if config.telescope.obscuration else pupil


def lit_as_seen(pupil: PupilGeometry, pupils: PyramidPupils) -> PupilGeometry:
    """A pupil, brightened or dimmed by the light of its images relative to the design's."""
    n, p = pupil.n_sub, pupil.n_pix
    design = ndimage.gaussian_filter(np.square(pupil.amplitude, dtype=float), SOFT * p)
    # Boxes lie a fraction of a pixel beside their images.
    beside = pupils.corners_px + (n - 1) / 2 - pupils.centres_px
    moved = [ndimage.shift(design, (-y * p, -x * p), order=1) for x, y in beside]
    expected = np.mean(moved, axis=0).reshape(n, p, n, p).sum(axis=(1, 3))
    telling = expected > _TELLING * expected.max()
    share = np.where(telling, pupils.flux / np.where(telling, expected, 1.0), 0.0)
    # Beyond the last pixel that tells, the nearest one does.
    share = share[tuple(ndimage.distance_transform_edt(~telling, return_indices=True)[1])]
    at = (np.arange(n * p) + 0.5) / p - 0.5
    x, y = beside.mean(axis=0)
    at_samples = np.meshgrid(at - y, at - x, indexing="ij")
    dimmed = ndimage.map_coordinates(share / np.percentile(share, 95), at_samples, order=1, mode="nearest")
    amplitude = pupil.amplitude * np.sqrt(np.maximum(dimmed, _DIMMEST))
    return replace(pupil, amplitude=amplitude.astype(np.float32))


def usual_samples(config: SystemConfig) -> int:
    """Pupil samples across a sub-aperture: as many as the mirror or the lenslets ask for.

    A pyramid's sub-aperture is a pixel of the pupil image, which may be wider than an actuator pitch.
    """
    if config.sensor.kind != "pyramid":
        return PUPIL_SAMPLES
    least = SAMPLES_PER_PITCH * config.devices.dm.pitches_across_pupil / config.sensor.n_sub
    return max(1, math.ceil(least))


def soiled_pupil(config: SystemConfig, rng: np.random.Generator) -> PupilGeometry:
    """The pupil of the twin, with whatever ``twin.contamination`` puts on it."""
    pupil, dirt = pupil_geometry(config), config.twin.contamination
    share = soiled_share(dirt, config.system.pupil_m, pupil.coordinates_m, rng)
    return replace(pupil, amplitude=(pupil.amplitude * np.sqrt(share)).astype(np.float32))


def actuator_positions(config: SystemConfig) -> NDArray[np.float64]:
    """Actuator positions ``(n_act, 2)`` as (x, y) in metres on the pupil."""
    return config.devices.dm.positions() * pitch_on_pupil(config)


def pitch_on_pupil(config: SystemConfig) -> float:
    """Actuator pitch in metres, as relayed onto the pupil."""
    return config.system.pupil_m / config.devices.dm.pitches_across_pupil
