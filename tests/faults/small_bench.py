"""The bundled twin made small, so that the tests run at thousands of frames per second."""

from __future__ import annotations

import numpy as np

from escape_hw.config.load import load_system
from escape_hw.config.models import SystemConfig
from escape_hw.runtime.system import System
from escape_hw.testing import FaultyCamera, FaultyMirror

#: 12 x 12 lenslets, 37 actuators, 30 modes, moderate turbulence; everything else as on the real bench.
SMALL = (
    "sensor.n_sub=12",
    "sensor.beam_radius_m=inf",
    "devices.wfs.region=[220,156,200,200]",
    'devices.dm.layout="circle-7"',
    "devices.dm.pitches_across_pupil=5.0",
    "devices.dm.pitch_m=2.7e-3",
    "devices.screen.screen=2",
    "basis.n_modes=30",
    "calibration.sprint_modes=20",
    "loop.dropped_modes=4",
    "twin.wfs.photons_per_frame=2.5e6",
)
PLANTED = np.array([-16.0, -71.0, -0.77, 2.9, 0.0])


def configuration(*more: str, seed: int | None = None) -> SystemConfig:
    return load_system("razor-shwfs", overrides=(*SMALL, *more), seed=seed)


def small(*more: str, seed: int | None = None) -> System:
    """The small bench, not open."""
    return System.from_config(configuration(*more, seed=seed))


def faulty(
    *more: str, wfs: dict | None = None, science: dict | None = None, dm: dict | None = None
) -> System:
    """The small bench, not open, with devices that fail as told."""
    bench = small(*more)
    if wfs is not None:
        bench.wfs = FaultyCamera(bench.wfs, **wfs)
    if science is not None:
        bench.science = FaultyCamera(bench.science, **science)
    if dm is not None:
        bench.dm = FaultyMirror(bench.dm, **dm)
    return bench


def settled_shape(bench: System) -> np.ndarray:
    """Where the twin's actuators really go, whatever anybody believes about it: ``(n_act,)``."""
    twin = getattr(bench.dm, "inner", bench.dm)._bench
    dynamics = twin.dynamics
    dynamics.mean(dynamics._time, max(twin.now_s, dynamics._time) + 1.0)
    assert not dynamics._pending
    return dynamics._target.copy()


def assert_flat(bench: System) -> None:
    """Flat by the guard's book and by the twin's own actuators."""
    assert not bench.dm.shape.any()
    assert not settled_shape(bench).any()
