"""The contract suite on the twins of the bundled benches."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

from escape_hw.api.modulator import Modulation
from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig
from escape_hw.testing import Check, Factory, parametrize_device_checks
from escape_sim.devices import twins as devices
from escape_sim.devices import twins as sim_modulator
from escape_sim.devices import twins as sim_secondary


@cache
def configuration(system: str) -> SystemConfig:
    return load_system(system)


def fresh(make: Any, name: str, system: str = "razor-shwfs") -> Any:
    """Make a device with a bench of its own."""
    return make(name, configuration(system), {})


def slaved_camera() -> Any:
    """Make the camera of a bench whose modulator turns."""
    shared: dict[str, object] = {}
    config = configuration("razor-pywfs")
    with sim_modulator.make_modulator("modulator", config, shared) as stage:
        turning = stage.modulate(Modulation(1.4e-4, 303.0))
    bench = devices.shared_bench(config, shared)
    bench.beam_path.modulation = turning
    bench.plates.inserted = False
    return devices.make_wfs_camera("wfs", config, shared)


TWINS: dict[str, Factory] = {
    "sim-alpao": partial(fresh, devices.make_mirror, "dm"),
    "sim-asm": partial(fresh, sim_secondary.make_secondary, "dm"),
    "sim-ximea": partial(fresh, devices.make_wfs_camera, "wfs"),
    "sim-science": partial(fresh, devices.make_science_camera, "science"),
    "sim-screen": partial(fresh, devices.make_screen, "screen"),
    "sim-e727": partial(fresh, sim_modulator.make_modulator, "modulator", "razor-pywfs"),
    "sim-ximea-slaved": slaved_camera,
}


@parametrize_device_checks(TWINS)
def test_contract(factory: Factory, check: Check) -> None:
    check(factory)
