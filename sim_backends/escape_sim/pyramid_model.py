"""Synthetic model of a pyramid system: plain reference by push and pull."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.pyramid import PyramidPupils, boxes
from escape_hw.api.registration import Registration
from escape_hw.config.sensor_models import PyramidSection
from escape_hw.pipeline.pyramid_slopes import slopes_of_image
from escape_sim.geometry import actuator_positions, pitch_on_pupil, pupil_geometry
from escape_sim.influence import InfluenceFunctions
from escape_sim.modulation import Modulation
from escape_sim.pyramid import PyramidOptics

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig


def nominal_pupils(config: SystemConfig) -> PyramidPupils:
    """The design's pupil images, valid where the design beam is bright enough."""
    sensor, pupil = config.sensor_as(PyramidSection), pupil_geometry(config)
    flux = np.square(pupil.amplitude, dtype=float)
    flux /= np.percentile(flux[flux > 0], 95)
    valid = flux >= sensor.min_flux
    centres = np.array(sensor.pupils_px)
    return PyramidPupils(
        centres, float(sensor.n_sub), boxes(centres, sensor.n_sub), valid,
        np.zeros((int(valid.sum()), 2), np.float32), flux.astype(np.float32),
        normalisation=sensor.normalisation, modulation=sensor.modulation,
    )  # fmt: skip


class PyramidModel:
    """Small-signal slopes of a modulated pyramid behind a Gaussian-actuator mirror."""

    name = "fast"

    def __init__(self, config: SystemConfig, pupils: PyramidPupils) -> None:
        self._config, self._pupils, self._pupil = config, pupils, pupil_geometry(config)
        self._positions = actuator_positions(config)
        n = self._pupil.n_sub
        self._optics = PyramidOptics(
            self._pupil.amplitude, float(n), config.system.wavelength_m,
            np.asarray(pupils.corners_px + (n - 1) / 2, float), config.devices.wfs.region[:1:-1],
            Modulation.circle(pupils.modulation),
        )  # fmt: skip

    @property
    def n_act(self) -> int:
        """Number of actuators."""
        return len(self._positions)

    @property
    def sub_aperture_m(self) -> float:
        """Size of a pixel of the pupil image in metres."""
        return self._pupil.sub_aperture_m

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """See :class:`SyntheticModel`."""
        x = self._pupil.coordinates_m
        surfaces = self._influence(1.0).surfaces(Registration(), self.sub_aperture_m, x, x)
        return surfaces, self._pupil.lit, self._pupil.pixel_m

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes per unit command ``(n_slopes, n_act)``."""
        x = self._pupil.coordinates_m
        surfaces = self._influence(width).surfaces(registration, self.sub_aperture_m, x, x)
        step = 1e-9
        columns = []
        for surface in surfaces:
            push, pull = (
                slopes_of_image(self._optics.frame((sign * step * surface).astype(np.float32)), self._pupils)
                for sign in (1, -1)
            )
            columns.append((push - pull) * (self._config.devices.dm.stroke_m / step))
        return np.stack(columns, axis=1)

    def variants(self) -> list[PyramidModel]:
        """None."""
        return []

    def _influence(self, width: float) -> InfluenceFunctions:
        return InfluenceFunctions(
            self._positions, pitch_on_pupil(self._config), self._config.devices.dm.coupling, width
        )
