"""The emulated E-727 on a bus of pyusb, for a driver in the same process, and its trigger pulses."""

from __future__ import annotations

import errno
import time
from types import SimpleNamespace
from typing import Any

import numpy as np
import usb.backend
import usb.core
from numpy.typing import NDArray

from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.stage import SERVO_S, Wave
from escape_sim.emulators.e727.transports import ClientSession, ConnectionCut, FaultInjector

#: PI's vendor number, and a product number in place of one that is not public.
VENDOR, PRODUCT = 0x1A72, 0x1000
_OUT, _IN, _BULK, _PACKET = 0x02, 0x81, 0x02, 64
#: Request for a string descriptor, and index of the serial number's string.
_GET_DESCRIPTOR, _STRING, _SERIAL = 0x06, 0x03, 3


class UsbPipe:
    """Bulk endpoints of the controller, for a replacement of libusb."""

    def __init__(self, controller: E727Controller, faults: FaultInjector) -> None:
        self._controller = controller
        self.client_session = ClientSession(controller, faults)
        self._outgoing = bytearray()
        self.is_plugged = True

    @property
    def serial(self) -> str:
        """Serial number in the device's descriptor."""
        return self._controller.settings.serial

    def write(self, data: bytes) -> None:
        """Bulk transfer to the controller; raises ConnectionError if it is unplugged."""
        if not self.is_plugged:
            raise ConnectionError
        if len(data) % 2:
            self._controller.state.report_violation(
                f"a USB transfer of {len(data)} bytes; pad it to an even number"
            )
        try:
            self._outgoing += self.client_session.feed(data)
        except ConnectionCut:
            self.is_plugged = False
            raise ConnectionError from None

    def read(self, size: int, timeout_s: float) -> bytes:
        """Bulk transfer from the controller; empty after ``timeout_s``. ConnectionError if unplugged."""
        deadline = time.monotonic() + timeout_s
        while not self._outgoing and time.monotonic() < deadline:
            if not self.is_plugged:
                raise ConnectionError
            time.sleep(min(0.002, timeout_s))
        data, self._outgoing = bytes(self._outgoing[:size]), self._outgoing[size:]
        return data


class UsbBackend(usb.backend.IBackend):  # type: ignore[misc]
    """A bus with one controller, to be passed to pyusb as ``backend``.

    ``kernel_driver_active``: a kernel driver holds the interface until it is detached.
    """

    def __init__(self, pipe: UsbPipe, *, kernel_driver_active: bool = False) -> None:
        self._pipe = pipe
        self.kernel_driver = kernel_driver_active
        self.claimed = False

    def enumerate_devices(self) -> Any:
        return iter([self] if self._pipe.is_plugged else [])

    def get_device_descriptor(self, dev: Any) -> Any:
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=0x0200, bDeviceClass=0xFF, bDeviceSubClass=0,
            bDeviceProtocol=0, bMaxPacketSize0=_PACKET, idVendor=VENDOR, idProduct=PRODUCT, bcdDevice=0x0100,
            iManufacturer=1, iProduct=2, iSerialNumber=_SERIAL, bNumConfigurations=1, address=7, bus=1,
            port_number=1, port_numbers=(1,), speed=3,
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: Any, config: int) -> Any:
        if config:
            raise IndexError(config)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=32, bNumInterfaces=1, bConfigurationValue=1,
            iConfiguration=0, bmAttributes=0xC0, bMaxPower=50, extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: Any, intf: int, alt: int, config: int) -> Any:
        if intf or alt:
            raise IndexError(intf)
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=0, bAlternateSetting=0, bNumEndpoints=2,
            bInterfaceClass=0xFF, bInterfaceSubClass=0, bInterfaceProtocol=0, iInterface=0,
            extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: Any, ep: int, intf: int, alt: int, config: int) -> Any:
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=(_OUT, _IN)[ep], bmAttributes=_BULK,
            wMaxPacketSize=_PACKET, bInterval=0, bRefresh=0, bSynchAddress=0, extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: Any) -> Any:
        return self

    def close_device(self, dev_handle: Any) -> None:
        self._pipe.client_session.finish()

    def get_configuration(self, dev_handle: Any) -> int:
        return 1

    def set_configuration(self, dev_handle: Any, config_value: int) -> None:
        pass

    def claim_interface(self, dev_handle: Any, intf: int) -> None:
        if self.kernel_driver or self.claimed:
            raise usb.core.USBError("Resource busy", -6, errno.EBUSY)
        self.claimed = True

    def release_interface(self, dev_handle: Any, intf: int) -> None:
        self.claimed = False

    def is_kernel_driver_active(self, dev_handle: Any, intf: int) -> bool:
        return self.kernel_driver

    def detach_kernel_driver(self, dev_handle: Any, intf: int) -> None:
        self.kernel_driver = False

    def attach_kernel_driver(self, dev_handle: Any, intf: int) -> None:
        self.kernel_driver = True

    def bulk_write(self, dev_handle: Any, ep: int, intf: int, data: Any, timeout: int) -> int:
        try:
            self._pipe.write(bytes(data))
        except ConnectionError:
            raise _no_device_error() from None
        return len(data)

    def bulk_read(self, dev_handle: Any, ep: int, intf: int, buff: Any, timeout: int) -> int:
        try:
            data = self._pipe.read(len(buff), timeout / 1000)
        except ConnectionError:
            raise _no_device_error() from None
        if not data:
            raise usb.core.USBTimeoutError("Operation timed out", -7, errno.ETIMEDOUT)
        buff[: len(data)] = type(buff)(buff.typecode, data)
        return len(data)

    def ctrl_transfer(
        self,
        dev_handle: Any,
        bmRequestType: int,
        bRequest: int,
        wValue: int,
        wIndex: int,
        data: Any,
        timeout: int,
    ) -> int:
        kind, number = divmod(wValue, 256)
        if bRequest != _GET_DESCRIPTOR or kind != _STRING:
            raise usb.core.USBError("Pipe error", -9, errno.EPIPE)
        text = {1: "PI", 2: "E-727", _SERIAL: self._pipe.serial}.get(number, "")
        body = text.encode("utf-16-le") if number else b"\x09\x04"
        reply = bytes([len(body) + 2, _STRING]) + body
        data[: len(reply)] = type(data)(data.typecode, reply)
        return len(reply)


def _no_device_error() -> Any:
    return usb.core.USBError("No such device (it may have been disconnected)", -4, errno.ENODEV)


def pulses_s(controller: E727Controller, line: int, name: str) -> NDArray[np.float64]:
    """Times of rising edges within one cycle ``(n,)`` in seconds; empty without trigger."""
    waves, wave = controller.waves, controller.state.stage.axes[name].trajectory
    levels = waves.levels.get(line, {})
    if waves.outputs.get((line, 3)) != 4 or not levels or not isinstance(wave, Wave):
        return np.empty(0)
    level, points = 0, []
    for point in range(1, len(wave.table) + 1):
        before, level = level, levels.get(point, level)
        if level > before:
            points.append(point - 1)
    return np.array(points, float) * wave.rate * SERVO_S
