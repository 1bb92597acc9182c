"""Optics of a system's wavefront sensor, by kind and by implementation."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from escape_hw.config.sensor import PyramidSection
from escape_sim.optics.base import SensorOptics
from escape_sim.optics.distorted_lenslets import DistortedShackHartmannOptics
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pupil import PupilGeometry, true_diameter
from escape_sim.optics.pyramid import PyramidOptics
from escape_sim.optics.shack_hartmann import LensletOptics, ShackHartmannOptics

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig
    from escape_sim.oopao.optics import OOPAOPyramid


def make_sensor_optics(config: SystemConfig, pupil: PupilGeometry) -> SensorOptics:
    """Build the true optics of the twin's sensor, which differ from the design as configured in ``[twin]``.

    A pyramid is without modulation, with its images at their true positions.
    """
    pyramid_class: type[PyramidOptics | OOPAOPyramid] = PyramidOptics
    lenslet_class: type[LensletOptics] = ShackHartmannOptics
    if config.system.optics == "oopao":
        # Imported here: OOPAO takes two seconds and 1,600 modules to load.
        from escape_sim.oopao.optics import OOPAOPyramid, OOPAOShackHartmann

        pyramid_class, lenslet_class = OOPAOPyramid, OOPAOShackHartmann
    amplitude = pupil.amplitude / np.sqrt(np.sum(np.square(pupil.amplitude, dtype=float)))
    amplitude = amplitude.astype(np.float32)
    sensor, wavelength_m, shape = config.sensor, config.system.wavelength_m, config.devices.wfs.region[:1:-1]
    if isinstance(sensor, PyramidSection):
        twin = config.twin.pyramid
        return pyramid_class(
            amplitude, true_diameter(config), wavelength_m, np.add(sensor.pupils_px, twin.centre_offsets_px),
            shape, ModulationPath.circle(0.0), rooftop=twin.rooftop, samples=pupil.n_pix,
        )  # fmt: skip
    pitch = config.twin.wfs.pitch_px or sensor.pitch_px
    x, y = (
        (length - 1) / 2 - pitch * (sensor.n_sub - 1) / 2 + offset
        for length, offset in zip(shape[::-1], config.twin.wfs.grid_offset_px, strict=True)
    )
    geometry = (sensor.n_sub, pupil.n_pix, wavelength_m, pitch, sensor.spot_px, (x, y), shape, amplitude)
    true = config.twin.wfs
    if true.clocking_deg or true.distortion:
        return DistortedShackHartmannOptics(
            *geometry, clocking=math.radians(true.clocking_deg), distortion=true.distortion
        )
    return lenslet_class(*geometry)
