"""OOPAO as the synthetic pyramid model that SPRINT inverts: the reference for the fast model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import Registration
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.geometry import pupil_geometry
from escape_sim.modulation import Modulation
from escape_sim.oopao_bridge import quiet
from escape_sim.oopao_mirror import STEP_M, NominalMirror
from escape_sim.oopao_pyramid import OOPAOPyramid

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig


class OOPAOPyramidModel:
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

    name = "oopao"

    def __init__(self, config: SystemConfig, pupils: PyramidPupils) -> None:
        pupil = pupil_geometry(config)
        if pupils.valid.shape != (pupil.n_sub, pupil.n_sub):
            raise CalibrationError(
                f"the pupil images have {pupils.valid.shape} pixels; sensor.n_sub is {pupil.n_sub}"
            )
        self._pupil, self._pupils = pupil, pupils
        self._sensor = OOPAOPyramid(
            pupil.amplitude, float(pupil.n_sub), config.system.wavelength_m, pupils.centres_px,
            config.devices.wfs.region[:1:-1], Modulation.circle(pupils.modulation), samples=pupil.n_pix,
            diameter_m=pupil.sub_aperture_m * pupil.n_sub,
        )  # fmt: skip
        self._mirror = NominalMirror(config, pupil, self._sensor.light)

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return self._mirror.n_act

    @property
    def sub_aperture_m(self) -> float:
        """Size of a pixel of the pupil image in metres."""
        return self._pupil.sub_aperture_m

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """Nominal influence functions ``(n_act, n, n)``, pupil ``(n, n)`` and pixel size in metres."""
        return self._mirror.influence_functions()

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)``, all x then all y.

        Parameters
        ----------
        registration
            Registration of the mirror.
        width
            Scale of the influence functions' width relative to nominal.
        """
        mirror = self._mirror.moved(registration, width)
        n = len(self._pupil.coordinates_m)
        out = np.empty((self._pupils.n_slopes, self.n_act))
        for actuator in range(self.n_act):
            poke = np.zeros(self.n_act)
            # The mirror reflects: a surface of STEP_M changes the path by twice that.
            poke[actuator] = 2 * STEP_M
            with quiet():
                mirror.coefs = poke
            path = np.asarray(mirror.OPD, dtype=float).reshape(n, n)
            out[:, actuator] = self._slopes(path) - self._slopes(-path)
        return out * self._mirror.per_step

    def variants(self) -> list[OOPAOPyramidModel]:
        """None: it knows no turbulence, see :class:`SyntheticModel`."""
        return []

    def _slopes(self, path_m: NDArray[np.float64]) -> NDArray[np.float64]:
        # In double precision: the steps are small.
        return slopes_of_image(self._sensor.frame(path_m, np.zeros(self._sensor.shape)), self._pupils)
