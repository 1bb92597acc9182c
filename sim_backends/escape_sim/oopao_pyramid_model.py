"""OOPAO as the synthetic pyramid model that SPRINT inverts: the reference for the fast model."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.geometry import pupil_of_images
from escape_sim.modulation import Modulation
from escape_sim.oopao_bridge import quiet
from escape_sim.oopao_push_pull import PushPullModel
from escape_sim.oopao_pyramid import OOPAOPyramid

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig


class OOPAOPyramidModel(PushPullModel):
    """Small-signal slopes with mirror, registration, field and prism by OOPAO 1.0.

    Slopes are push minus pull about a flat wavefront. OOPAO's own slopes are not used, for they take
    the four images for a perfect square.

    Parameters
    ----------
    config
        The design: sensor, mirror and beam. Its ``twin`` section is not read.
    pupils
        The pupil images found on the camera.

    Raises
    ------
    ConfigError
        OOPAO is not installed.
    CalibrationError
        The pupils do not fit the design.
    """

    def __init__(self, config: SystemConfig, pupils: PyramidPupils) -> None:
        pupil = pupil_of_images(config, pupils)
        self._pupils = pupils
        self._sensor = OOPAOPyramid(
            pupil.amplitude, float(pupil.n_sub), config.system.wavelength_m, pupils.centres_px,
            config.devices.wfs.region[:1:-1], Modulation.circle(pupils.modulation), samples=pupil.n_pix,
            diameter_m=pupil.sub_aperture_m * pupil.n_sub,
        )  # fmt: skip
        super().__init__(config, pupil, self._sensor.light)

    def _slopes(self, mirror: Any, paths_m: NDArray[np.float64]) -> NDArray[np.float64]:
        n = len(self._pupil.coordinates_m)
        out = np.empty((self._pupils.n_slopes, paths_m.shape[1]))
        for number, path in enumerate(paths_m.T):
            with quiet():
                mirror.coefs = path
            surface = np.asarray(mirror.OPD, dtype=float).reshape(n, n)
            # In double precision: the steps are small.
            frame = self._sensor.frame(surface, np.zeros(self._sensor.shape))
            out[:, number] = slopes_of_image(frame, self._pupils)
        return out
