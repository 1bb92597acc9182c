"""Design geometry shared by the twin and by the synthetic model, both built from the configuration."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_sim.influence import layout_positions

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Pupil samples across one lenslet: alias-free to +-4 lambda/d, several times the largest tilt.
PUPIL_SAMPLES = 8
#: Pupil samples across one sub-aperture, by kind of sensor; a pyramid's is a pixel of the pupil image.
_SAMPLES = {"shack-hartmann": PUPIL_SAMPLES, "pyramid": 1}


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
    """The pupil that the configuration describes: round, lit by a Gaussian beam.

    Parameters
    ----------
    config
        The system.
    n_pix
        Samples across a sub-aperture; as usual for the kind of sensor by default.
    """
    n_pix = n_pix or _SAMPLES[config.sensor.kind]
    n_sub, diameter = config.sensor.n_sub, config.system.pupil_m
    d = diameter / n_sub
    n = n_sub * n_pix
    x = (np.arange(n) - (n - 1) / 2) * d / n_pix
    r2 = x[:, None] ** 2 + x[None, :] ** 2
    amplitude = np.where(r2 <= (diameter / 2) ** 2, np.exp(-r2 / config.sensor.beam_radius_m**2), 0.0)
    return PupilGeometry(n_sub, n_pix, d, x, amplitude.astype(np.float32))


def actuator_positions(config: SystemConfig) -> NDArray[np.float64]:
    """Actuator positions ``(n_act, 2)`` as (x, y) in metres on the pupil."""
    return layout_positions(config.devices.dm.actuator_map(), pitch_on_pupil(config))


def pitch_on_pupil(config: SystemConfig) -> float:
    """Actuator pitch in metres, as relayed onto the pupil."""
    return config.system.pupil_m / config.devices.dm.pitches_across_pupil
