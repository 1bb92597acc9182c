"""The contract suite on the E-727's driver, over network, serial line and USB, against the emulator."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

import pytest
from usb_bus import VENDOR, UsbBackend, UsbPipe

from escape_drivers.pi.modulator import PiModulator
from escape_drivers.pi.transports import SerialTransport, UsbTransport
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext
from escape_hw.config.system import SystemConfig
from escape_hw.testing import Check, Factory, parametrize_device_checks
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.state import ControllerSettings
from escape_sim.emulators.e727.transports import FaultInjector, PtyServer

MAKE = ControllerSettings(serial="SIMMOD", zeroed=True)


@cache
def configuration() -> SystemConfig:
    wire = ('devices.modulator.wire.kind="emulator"', 'devices.modulator.options={zeroed="1"}')
    return load_system("razor-pywfs", overrides=wire)


class PtyTransport(SerialTransport):
    """A serial line to an emulator that lives as long as the connection."""

    def __init__(self) -> None:
        super().__init__("not yet", 115200, 1.0)
        self._server = PtyServer(E727Controller(MAKE), FaultInjector())

    def open(self) -> None:
        self.where = self._server.start().removeprefix("pty ")
        super().open()

    def close(self) -> None:
        super().close()
        self._server.stop()


def over_tcp() -> PiModulator:
    config = configuration()
    return PiModulator.from_section(config.devices.modulator, DeviceContext("modulator", config))


def with_wire(connect: Callable[[], SerialTransport | UsbTransport]) -> PiModulator:
    section = configuration().devices.modulator
    assert section is not None
    return PiModulator("SIMMOD", stage=section.stage, max_tilt_rad=section.max_tilt_rad, connect=connect)


def over_serial() -> PiModulator:
    return with_wire(PtyTransport)


def over_usb() -> PiModulator:
    def connect() -> UsbTransport:
        bus = UsbBackend(UsbPipe(E727Controller(MAKE), FaultInjector()), kernel_driver_active=True)
        return UsbTransport(VENDOR, None, "SIMMOD", 1.0, bus)

    return with_wire(connect)


@parametrize_device_checks({"tcp": over_tcp})
def test_contract(factory: Factory, check: Check) -> None:
    check(factory)


@pytest.mark.slow
@parametrize_device_checks({"serial": over_serial, "usb": over_usb})
def test_contract_over_other_wires(factory: Factory, check: Check) -> None:
    check(factory)
