"""Optics of a system's wavefront sensor, by kind and by implementation."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from escape_sim.geometry import PupilGeometry
from escape_sim.shack_hartmann import ShackHartmannOptics

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig


class SensorOptics(Protocol):
    """Optics of a wavefront sensor: optical path in metres to relative intensity."""

    def frame(
        self, opd_m: NDArray[np.float32], image: NDArray[np.float32] | None = None
    ) -> NDArray[np.float32]:
        """Add the intensity to ``image`` and return it."""
        ...


def make_sensor_optics(config: SystemConfig, pupil: PupilGeometry) -> SensorOptics:
    """The twin's sensor as it really stands, which the design does not know exactly."""
    c, twin = config, config.twin.wfs
    n_sub, pitch = c.sensor.n_sub, twin.pitch_px or c.sensor.pitch_px
    width, height = c.devices.wfs.region[2:]
    origin = (
        (width - 1) / 2 - pitch * (n_sub - 1) / 2 + twin.grid_offset_px[0],
        (height - 1) / 2 - pitch * (n_sub - 1) / 2 + twin.grid_offset_px[1],
    )
    amplitude = pupil.amplitude / np.sqrt(np.sum(np.square(pupil.amplitude, dtype=float)))
    geometry = (
        n_sub, pupil.n_pix, c.system.wavelength_m, pitch, c.sensor.spot_px, origin, (height, width),
        amplitude.astype(np.float32),
    )  # fmt: skip
    if c.system.optics == "oopao":
        # Imported here: OOPAO loads for two seconds and 1,600 modules.
        from escape_sim.oopao_optics import OOPAOShackHartmann

        return OOPAOShackHartmann(*geometry)
    return ShackHartmannOptics(*geometry)
