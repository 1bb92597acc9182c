"""Serial line and USB: not there, not ours, unplugged in the middle."""

from __future__ import annotations

import errno
import time

import pytest
import usb.core
from usb_bus import VENDOR, UsbBackend, UsbPipe

from escape_drivers.pi.modulator import PiModulator
from escape_drivers.pi.transports import SerialTransport, TransportLost, UsbTransport
from escape_hw.api.modulator import Modulation
from escape_hw.config.loader import load_system
from escape_hw.errors import DeviceLost
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.state import ControllerSettings
from escape_sim.emulators.e727.transports import FaultInjector, PtyServer

CIRCLE = Modulation(1.41e-4, 303.03)
LONGEST_S = 10.0


def stage(transport) -> PiModulator:
    section = load_system("razor-pywfs").devices.modulator
    assert section is not None
    return PiModulator("SIMMOD", name="stage", stage=section.stage, connect=lambda: transport, timeout_s=0.2)


def controller() -> E727Controller:
    return E727Controller(ControllerSettings(serial="SIMMOD", zeroed=True))


def bus(**options) -> UsbBackend:
    return UsbBackend(UsbPipe(controller(), FaultInjector()), **options)


def lost_in_time(call, says: str) -> None:
    began = time.monotonic()
    with pytest.raises(DeviceLost, match=says):
        call()
    assert time.monotonic() - began < LONGEST_S


def test_a_serial_cable_pulled_out_in_the_middle():
    server = PtyServer(controller(), FaultInjector())
    device = stage(SerialTransport(server.start().removeprefix("pty "), 115200, 0.2)).open()
    device.modulate(CIRCLE)
    server.stop()
    lost_in_time(
        lambda: device.modulate(CIRCLE), r"lost /dev/pts/\d+ .*; is the cable plugged in|does not answer"
    )
    lost_in_time(device.close, r"lost|does not answer")
    assert not device.is_open


def test_a_serial_line_that_is_not_there():
    lost_in_time(
        stage(SerialTransport("/dev/nobody", 115200, 0.2)).open, r"cannot open /dev/nobody .* 'dialout'"
    )


def test_a_serial_line_in_use_by_another_process():
    server = PtyServer(controller(), FaultInjector())
    port = server.start().removeprefix("pty ")
    try:
        with stage(SerialTransport(port, 115200, 0.2)):
            lost_in_time(stage(SerialTransport(port, 115200, 0.2)).open, r"no other program hold it")
    finally:
        server.stop()


def test_usb_pulled_out_in_the_middle():
    here = bus()
    device = stage(UsbTransport(VENDOR, None, "SIMMOD", 0.2, here)).open()
    device.modulate(CIRCLE)
    here._pipe.is_plugged = False
    lost_in_time(lambda: device.modulate(CIRCLE), r"lost USB 1a72:\* SIMMOD .*; is the cable plugged in")
    lost_in_time(device.close, r"lost|does not answer")
    here._pipe.is_plugged = True
    with device:
        assert device.modulation is None


def test_usb_is_taken_from_the_kernel_and_given_back():
    here = bus(kernel_driver_active=True)
    with stage(UsbTransport(VENDOR, None, "SIMMOD", 0.2, here)):
        assert (here.kernel_driver, here.claimed) == (False, True)
    assert (here.kernel_driver, here.claimed) == (True, False)


def test_usb_in_use_is_reported():
    here = bus()
    with stage(UsbTransport(VENDOR, None, "SIMMOD", 0.2, here)):
        lost_in_time(stage(UsbTransport(VENDOR, None, "SIMMOD", 0.2, here)).open, r"cannot claim USB 1a72:\*")


@pytest.mark.parametrize(
    ("product", "serial", "says"),
    [
        (
            None,
            "4711",
            r"0 controllers match USB 1a72:\* 4711 \(there: SIMMOD\); correct serial",
        ),
        (0x9999, "", r"0 controllers match USB 1a72:9999 \(there: none of this vendor\)"),
    ],
)
def test_usb_that_is_not_the_one_wanted(product, serial, says):
    lost_in_time(stage(UsbTransport(VENDOR, product, serial, 0.2, bus())).open, says)


def test_usb_without_permission(monkeypatch):
    here = bus()

    def refused(*args, **options):
        raise usb.core.USBError("Access denied (insufficient permissions)", -3, errno.EACCES)

    monkeypatch.setattr(here, "claim_interface", refused)
    lost_in_time(stage(UsbTransport(VENDOR, None, "SIMMOD", 0.2, here)).open, r"udev rules installed")


@pytest.mark.parametrize(
    "transport", [SerialTransport("/dev/x", 9600, 0.1), UsbTransport(1, None, "", 0.1, bus())]
)
def test_a_wire_that_is_not_open_is_reported(transport):
    for call in (lambda: transport.write(b"x"), lambda: transport.read(0.0)):
        with pytest.raises(TransportLost, match="is not open"):
            call()
    transport.close()
