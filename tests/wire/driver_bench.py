"""Real drivers on the stand-ins of their vendors' libraries."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from functools import cache
from typing import Any

import pytest

from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext, device_factory
from escape_hw.config.system import SystemConfig
from escape_hw.errors import DeviceError, NotOpen
from escape_sim.stand_ins import StandIn, StandInUnavailable

#: Driver, key in [devices] and stand-in.
PARTS = {"alpao": ("dm", "asdk"), "ximea": ("wfs", "m3api"), "aravis": ("science", "aravis")}


@cache
def stand_in(name: str) -> StandIn:
    """The stand-in, or a skip that says why there is none."""
    try:
        return StandIn(name)
    except StandInUnavailable as reason:
        pytest.skip(str(reason), allow_module_level=True)


def fresh(name: str, script: str = "") -> StandIn:
    """The stand-in with everything before forgotten, recording, with a script of faults."""
    return stand_in(name).clear().script(script)


@cache
def _configuration(system: str, overrides: tuple[str, ...]) -> SystemConfig:
    return load_system(system, mode="hardware", overrides=overrides)


def configuration_of(driver: str, *more: str, system: str = "razor-shwfs") -> SystemConfig:
    """The configuration with this driver on the stand-in."""
    key, library = PARTS[driver]
    path = stand_in(library).path
    chosen = (f'devices.{key}.driver="{driver}"', f'devices.{key}.options.library="{path}"')
    return _configuration(system, (*chosen, *more))


def make(driver: str, *more: str, system: str = "razor-shwfs") -> Any:
    """A closed device of the system, on an unmodified stand-in."""
    config, key = configuration_of(driver, *more, system=system), PARTS[driver][0]
    section = getattr(config.devices, key)
    return device_factory(driver, hardware=True)(section, DeviceContext(key, config))


def end_wait(camera: Any, call: Callable[[], object]) -> None:
    """Call what ends another thread's wait for a frame long before its time-out."""
    outcome: list[BaseException] = []

    def wait() -> None:
        try:
            camera.next_frame(60.0)
        except DeviceError as error:
            outcome.append(error)

    waiter = threading.Thread(target=wait)
    waiter.start()
    time.sleep(0.12)
    began = time.monotonic()
    call()
    waiter.join(10)
    assert time.monotonic() - began < 5
    assert not waiter.is_alive()
    assert isinstance(outcome[0], NotOpen)
