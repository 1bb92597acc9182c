"""The bundled pyramid twin made small, so that the tests run at hundreds of frames per second."""

from __future__ import annotations

import numpy as np

from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig
from escape_hw.runtime.session.system import System

#: Images of 16 pixels, 37 actuators, 20 modes, moderate turbulence; everything else as on the real bench.
SMALL = (
    "sensor.n_sub=16",
    "sensor.beam_radius_m=inf",
    "sensor.pupils_px=[[15.5,16.0],[48.0,18.5],[16.0,47.0],[44.5,46.0]]",
    "devices.wfs.region=[288,224,64,64]",
    'devices.dm.layout="circle-7"',
    "devices.dm.pitches_across_pupil=5.0",
    "devices.dm.pitch_m=2.7e-3",
    "devices.screen.screen=2",
    "basis.n_modes=20",
    "calibration.sprint_modes=15",
    "loop.dropped_modes=2",
    "twin.wfs.photons_per_frame=4.0e6",
)


def configuration(*more: str, seed: int | None = None) -> SystemConfig:
    return load_system("razor-pywfs", overrides=(*SMALL, *more), seed=seed)


def small(*more: str, seed: int | None = None) -> System:
    """The small bench, not open."""
    return System.from_config(configuration(*more, seed=seed))


def true_centres(bench: System) -> np.ndarray:
    """Where the twin's pupil images really lie ``(4, 2)``."""
    return np.add(bench.config.sensor.pupils_px, bench.config.twin.pyramid.centre_offsets_px)
