"""The bundled twin made small, so that the tests run at thousands of frames per second."""

from __future__ import annotations

import numpy as np
from small_system import configuration

from escape_hw.runtime.session.system import System
from escape_hw.testing import FaultyCamera, FaultyMirror

INJECTED = np.array([-16.0, -71.0, -0.77, 2.9, 0.0])


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


def dead(bench: System, *actuators: int) -> None:
    """Make actuators take commands and not move, unknown to the configuration."""
    real = bench.dm._send

    def send(command: np.ndarray) -> None:
        reached = command.copy()
        reached[list(actuators)] = 0.0
        real(reached)

    bench.dm._send = send


def settled_shape(bench: System) -> np.ndarray:
    """Where the twin's actuators really go, whatever the configuration says: ``(n_act,)``."""
    twin = getattr(bench.dm, "inner", bench.dm)._bench
    dynamics = twin.dynamics
    dynamics.mean(dynamics._time, max(twin.now_s, dynamics._time) + 1.0)
    assert not dynamics._pending
    return dynamics._target.copy()


def assert_flat(bench: System) -> None:
    """Flat by the guard's book and by the twin's own actuators."""
    assert not bench.dm.shape.any()
    assert not settled_shape(bench).any()
