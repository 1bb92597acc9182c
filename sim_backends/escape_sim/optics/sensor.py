"""Optics of a system's wavefront sensor, by kind and by implementation."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.config.sensor import PyramidSection, ShackHartmannSection
from escape_sim.optics.base import ModulatedOptics, SensorOptics
from escape_sim.optics.modulation import ModulationPath
from escape_sim.optics.pupil import PupilGeometry
from escape_sim.optics.pyramid import PyramidOptics
from escape_sim.optics.shack_hartmann import ShackHartmannOptics

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig
    from escape_sim.oopao.optics import OOPAOPyramid


def make_sensor_optics(config: SystemConfig, pupil: PupilGeometry) -> SensorOptics:
    """Build the true optics of the twin's sensor, which differ from the design as ``twin`` says."""
    amplitude = pupil.amplitude / np.sqrt(np.sum(np.square(pupil.amplitude, dtype=float)))
    if isinstance(config.sensor, PyramidSection):
        return make_pyramid(config, config.sensor, pupil, amplitude.astype(np.float32))
    return _make_lenslets(config, config.sensor, pupil, amplitude.astype(np.float32))


def make_pyramid(
    config: SystemConfig, sensor: PyramidSection, pupil: PupilGeometry, amplitude: NDArray[np.float32]
) -> ModulatedOptics:
    """Build a pyramid without modulation, with its images at their true positions."""
    optics_class: type[PyramidOptics | OOPAOPyramid] = PyramidOptics
    if config.system.optics == "oopao":
        # Imported here: OOPAO takes two seconds and 1,600 modules to load.
        from escape_sim.oopao.optics import OOPAOPyramid

        optics_class = OOPAOPyramid
    twin = config.twin.pyramid
    width, height = config.devices.wfs.region[2:]
    return optics_class(
        amplitude,
        float(pupil.n_sub),
        config.system.wavelength_m,
        np.add(sensor.pupils_px, twin.centre_offsets_px),
        (height, width),
        ModulationPath.circle(0.0),
        rooftop=twin.rooftop,
        samples=pupil.n_pix,
    )


def _make_lenslets(
    config: SystemConfig, sensor: ShackHartmannSection, pupil: PupilGeometry, amplitude: NDArray[np.float32]
) -> SensorOptics:
    c, twin = config, config.twin.wfs
    n_sub, pitch = sensor.n_sub, twin.pitch_px or sensor.pitch_px
    width, height = c.devices.wfs.region[2:]
    origin = (
        (width - 1) / 2 - pitch * (n_sub - 1) / 2 + twin.grid_offset_px[0],
        (height - 1) / 2 - pitch * (n_sub - 1) / 2 + twin.grid_offset_px[1],
    )
    geometry = (
        n_sub, pupil.n_pix, c.system.wavelength_m, pitch, sensor.spot_px, origin, (height, width), amplitude,
    )  # fmt: skip
    if c.system.optics == "oopao":
        from escape_sim.oopao.optics import OOPAOShackHartmann

        return OOPAOShackHartmann(*geometry)
    return ShackHartmannOptics(*geometry)
