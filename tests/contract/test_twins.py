"""The contract suite on the twins of small benches; what it requires does not depend on their size."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

import small_system

from escape_hw.api.camera import Camera
from escape_hw.api.mirror import DeformableMirror
from escape_hw.api.modulator import Modulation
from escape_hw.bench import build_device
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext
from escape_hw.config.system import SystemConfig
from escape_hw.testing import Check, Factory, parametrize_device_checks
from escape_sim.devices import twins


@cache
def configuration(system: str) -> SystemConfig:
    return small_system.configuration() if system == "razor-shwfs" else load_system(system)


def fresh(make: Any, name: str, system: str = "razor-shwfs") -> Any:
    """Make a device with a bench of its own."""
    return make(None, DeviceContext(name, configuration(system)))


def triggered_camera() -> Any:
    """Make the camera of a bench whose modulator runs."""
    shared: dict[str, object] = {}
    config = configuration("razor-pywfs")
    with twins.make_modulator(None, DeviceContext("modulator", config, shared)) as stage:
        modulation = stage.modulate(Modulation(1.4e-4, 303.0))
    bench = twins.shared_bench(config, shared)
    bench.beam_path.modulation = modulation
    bench.plates.inserted = False
    return twins.make_wfs_camera(None, DeviceContext("wfs", config, shared))


#: A camera that is turned and a mirror that counts and pulls otherwise, and keys that say so.
MOUNTED = [
    "twin.wfs.flip=left-right", "devices.wfs.flip=left-right", "twin.mirror.order=turn-90",
    "devices.dm.order=turn-90", "twin.mirror.polarity=-1", "devices.dm.polarity=-1",
]  # fmt: skip


def mounted(name: str, kind: Any) -> Any:
    """Make a device of such a bench."""
    return build_device(name, small_system.configuration(*MOUNTED), kind)


TWINS: dict[str, Factory] = {
    "sim-alpao": partial(fresh, twins.make_mirror, "dm"),
    "sim-alpao-rewired": partial(mounted, "dm", DeformableMirror),
    "sim-ximea-turned": partial(mounted, "wfs", Camera),
    "sim-asm": partial(fresh, twins.make_secondary, "dm"),
    "sim-ximea": partial(fresh, twins.make_wfs_camera, "wfs"),
    "sim-science": partial(fresh, twins.make_science_camera, "science"),
    "sim-screen": partial(fresh, twins.make_screen, "screen"),
    "sim-e727": partial(fresh, twins.make_modulator, "modulator", "razor-pywfs"),
    "sim-ximea-triggered": triggered_camera,
}


@parametrize_device_checks(TWINS)
def test_contract(factory: Factory, check: Check) -> None:
    check(factory)
