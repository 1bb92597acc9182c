"""The contract suite on the twins of the bundled bench."""

from __future__ import annotations

from functools import cache, partial
from typing import Any

from escape_hw.config.load import load_system
from escape_hw.config.models import SystemConfig
from escape_hw.testing import Check, Factory, parametrize_device_checks
from escape_sim import devices, sim_secondary


@cache
def configuration() -> SystemConfig:
    return load_system("razor-shwfs")


def fresh(make: Any, name: str) -> Any:
    """Make a device with a bench of its own."""
    return make(name, configuration(), {})


TWINS: dict[str, Factory] = {
    "sim-alpao": partial(fresh, devices.make_mirror, "dm"),
    "sim-asm": partial(fresh, sim_secondary.make_secondary, "dm"),
    "sim-ximea": partial(fresh, devices.make_wfs_camera, "wfs"),
    "sim-science": partial(fresh, devices.make_science_camera, "science"),
    "sim-screen": partial(fresh, devices.make_screen, "screen"),
}


@parametrize_device_checks(TWINS)
def test_contract(factory: Factory, check: Check) -> None:
    check(factory)
