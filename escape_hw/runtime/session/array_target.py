"""What the import of plain arrays needs of a system's configuration."""

from __future__ import annotations

import numpy as np

from escape_hw.config.sensor import PyramidSection
from escape_hw.config.system import SystemConfig
from escape_hw.io.interchange.arrays import ArrayTarget


def array_target(config: SystemConfig) -> ArrayTarget:
    """The system of a configuration, for :func:`~escape_hw.io.interchange.arrays.import_arrays`."""
    sensor, mirror, region = config.sensor, config.devices.dm, config.devices.wfs.region
    common = (config.system.name, config.simulated, sensor.n_sub, mirror.n_act, mirror.actuator_map())
    if isinstance(sensor, PyramidSection):
        pupils = np.array(sensor.pupils_px)
        return ArrayTarget(*common, 1.0, region[2:], pupils, sensor.normalisation, sensor.modulation)
    return ArrayTarget(*common, sensor.pitch_px, region[2:])
