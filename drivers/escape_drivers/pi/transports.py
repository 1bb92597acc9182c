"""Byte transports to a PI controller (TCP, serial line, USB, emulator) and the choice among them."""

from __future__ import annotations

import contextlib
import logging
import os
import socket
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, Protocol

from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from serial import Serial

    from escape_hw.api.emulator import Emulator
    from escape_hw.config.devices import WireConfig
    from escape_hw.config.registry import DeviceContext


log = logging.getLogger(__name__)

_RECEIVE_BYTES, _USB_READ_BYTES = 65536, 16384


class TransportLost(Exception):
    """The transport is lost; the message names the checks."""


class Transport(Protocol):
    """A wire. ``where`` names it in messages; all but ``close`` raise ``TransportLost`` on failure."""

    where: str

    def open(self) -> None:
        """Connect."""

    def close(self) -> None:
        """Disconnect; may be repeated, never raises."""

    def write(self, data: bytes) -> None:
        """Send all of it."""

    def read(self, timeout_s: float) -> bytes:
        """What has arrived, as soon as there is something; empty after the time."""


class TcpTransport:
    """The controller's network port; it takes one client at a time.

    ``connect_s`` and ``timeout_s`` limit the wait for a connection, and for the network to take a command.
    """

    def __init__(self, host: str, port: int, connect_s: float, timeout_s: float) -> None:
        self.where = f"{host}:{port}"
        self._address, self._connect_s, self._timeout_s = (host, port), connect_s, timeout_s
        self._socket: socket.socket | None = None

    def open(self) -> None:
        """Connect."""
        try:
            self._socket = socket.create_connection(self._address, timeout=self._connect_s)
        except TimeoutError as error:
            raise TransportLost(
                f"no answer from {self.where} within {self._connect_s:g} s; is the controller "
                "switched on, the cable plugged in, and host its address?"
            ) from error
        except OSError as error:
            raise TransportLost(
                f"cannot connect to {self.where} ({error.strerror or error}); is this the "
                "controller's address, and no other program connected to it? It serves one client at a time"
            ) from error
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)

    def close(self) -> None:
        """Disconnect."""
        if self._socket is not None:
            with contextlib.suppress(OSError):
                self._socket.shutdown(socket.SHUT_RDWR)
            self._socket.close()
            self._socket = None

    def write(self, data: bytes) -> None:
        """Send all of it."""
        wire = self._require_connected()
        wire.settimeout(self._timeout_s)
        try:
            wire.sendall(data)
        except OSError as error:
            raise self._lost_error(error) from error

    def read(self, timeout_s: float) -> bytes:
        """What has arrived."""
        wire = self._require_connected()
        # Zero means "do not wait at all"; the kernel's minimum wait is a millisecond.
        wire.settimeout(timeout_s)
        try:
            data = wire.recv(_RECEIVE_BYTES)
        except (TimeoutError, BlockingIOError):
            return b""
        except OSError as error:
            raise self._lost_error(error) from error
        if not data:
            raise self._lost_error(None)
        return data

    def _require_connected(self) -> socket.socket:
        if self._socket is None:
            raise TransportLost(f"not connected to {self.where}")
        return self._socket

    def _lost_error(self, error: OSError | None) -> TransportLost:
        how = "the controller hung up" if error is None else str(error.strerror or error)
        return TransportLost(
            f"connection to {self.where} lost ({how}); has another client been connected already (it "
            "serves one at a time), has it been switched off or reset, is the cable loose?"
        )


class SerialTransport:
    """A serial line, or USB that looks like one: 8 bits, no parity, 1 stop bit, no flow control."""

    def __init__(self, port: str, baud: int, timeout_s: float) -> None:
        self.where = port
        self._baud, self._timeout_s = baud, timeout_s
        self._serial: Serial | None = None

    def open(self) -> None:
        """Open the line for ourselves alone."""
        import serial

        try:
            self._serial = serial.Serial(
                self.where, self._baud, timeout=0, write_timeout=self._timeout_s, exclusive=True
            )
        except (OSError, ValueError) as error:
            raise TransportLost(
                f"cannot open {self.where} ({error}); is the cable plugged in, are you in the group "
                "'dialout', and does no other program hold it (also ModemManager and brltty)?"
            ) from error
        # Discard bytes that an earlier program left in the buffers.
        self._serial.reset_input_buffer()

    def close(self) -> None:
        """Close the line."""
        if self._serial is not None:
            with contextlib.suppress(OSError):
                self._serial.close()
            self._serial = None

    def write(self, data: bytes) -> None:
        """Send all of it."""
        line = self._require_open()
        try:
            line.write(data)
        except OSError as error:
            raise self._lost_error(error) from error

    def read(self, timeout_s: float) -> bytes:
        """What has arrived."""
        line = self._require_open()
        try:
            line.timeout = timeout_s
            # One byte is waited for, the others are there already.
            first: bytes = line.read(1)
            return first + bytes(line.read(line.in_waiting)) if first else b""
        except (OSError, TypeError) as error:
            # pyserial raises TypeError when the line is closed during a call.
            raise self._lost_error(error) from error

    def _require_open(self) -> Any:
        if self._serial is None:
            raise TransportLost(f"{self.where} is not open")
        return self._serial

    def _lost_error(self, error: Exception) -> TransportLost:
        return TransportLost(
            f"lost {self.where} ({error}); is the cable plugged in and the controller switched on? "
            "Open again then"
        )


class UsbTransport:
    """A controller found by the vendor's number and its serial number.

    Parameters
    ----------
    vendor, product
        USB numbers; ``None``: any product of the vendor's.
    serial
        Serial number that the device's descriptor must contain; empty: the only one there is.
    timeout_s
        Longest wait for it to take a command.
    backend
        libusb by default; a stand-in of it in tests.
    """

    def __init__(
        self, vendor: int, product: int | None, serial: str, timeout_s: float, backend: Any = None
    ) -> None:
        self._vendor, self._product, self._serial, self._backend = vendor, product, serial, backend
        self._timeout_s = timeout_s
        self.where = f"USB {vendor:04x}:{'*' if product is None else f'{product:04x}'} {serial}".rstrip()
        self._device: Any = None
        self._detached: list[int] = []
        self._out: Any = None
        self._in: Any = None

    def open(self) -> None:
        """Find and claim it."""
        import usb.core
        import usb.util

        self._device = self._find()
        try:
            self._claim(usb)
        except usb.core.USBError as error:
            self.close()
            raise TransportLost(
                f"cannot claim {self.where} ({error}); udev rules installed ('escape udev install'), "
                "and no other program connected to it?"
            ) from error

    def _find(self) -> Any:
        import usb.core

        wanted: dict[str, Any] = {"idVendor": self._vendor, "backend": self._backend, "find_all": True}
        if self._product is not None:
            wanted["idProduct"] = self._product
        try:
            present = list(usb.core.find(**wanted))
            found = [candidate for candidate in present if self._serial in (candidate.serial_number or "")]
        except usb.core.NoBackendError as error:
            raise TransportLost("pyusb finds no libusb; install libusb-1.0-0") from error
        except (usb.core.USBError, ValueError) as error:
            raise TransportLost(
                f"cannot read the serial numbers of {self.where} ({error}); install the udev rules: "
                "'escape udev install'"
            ) from error
        if len(found) != 1:
            serial_numbers = (
                ", ".join(candidate.serial_number or "?" for candidate in present) or "none of this vendor"
            )
            raise TransportLost(
                f"{len(found)} controllers match {self.where} (there: {serial_numbers}); correct "
                "serial, or see to cable and power"
            )
        return found[0]

    def _claim(self, usb: Any) -> None:
        interface = self._device.get_active_configuration()[(0, 0)]
        number = interface.bInterfaceNumber
        try:
            if self._device.is_kernel_driver_active(number):
                self._device.detach_kernel_driver(number)
                self._detached.append(number)
        except NotImplementedError:
            # pyusb raises this where the backend has no kernel drivers, so that none has to be detached.
            log.debug("%s: this USB backend has no kernel drivers", self.where)
        usb.util.claim_interface(self._device, number)
        for endpoint in interface:
            if usb.util.endpoint_type(endpoint.bmAttributes) != usb.util.ENDPOINT_TYPE_BULK:
                continue
            if usb.util.endpoint_direction(endpoint.bEndpointAddress) == usb.util.ENDPOINT_IN:
                self._in = endpoint
            else:
                self._out = endpoint
        if self._in is None or self._out is None:
            self.close()
            raise TransportLost(
                f"{self.where} has no pair of bulk endpoints; is usb_product the controller's?"
            )

    def close(self) -> None:
        """Give it back to the kernel's driver."""
        if self._device is None:
            return
        import usb.core
        import usb.util

        device, self._device, self._in, self._out = self._device, None, None, None
        with contextlib.suppress(usb.core.USBError):
            usb.util.dispose_resources(device)
        for number in self._detached:
            with contextlib.suppress(usb.core.USBError):
                device.attach_kernel_driver(number)
        self._detached = []

    def write(self, data: bytes) -> None:
        """Send all of it, padded to an even number of bytes as the controller expects."""
        import usb.core

        if self._out is None:
            raise TransportLost(f"{self.where} is not open")
        padded = data + b"\0" * (len(data) % 2)
        try:
            sent = self._out.write(padded, timeout=round(self._timeout_s * 1000))
        except usb.core.USBError as error:
            raise self._lost_error(error) from error
        if sent != len(padded):
            raise TransportLost(
                f"{self.where} took {sent} of {len(padded)} bytes; unplug it and plug it in again"
            )

    def read(self, timeout_s: float) -> bytes:
        """What has arrived."""
        import usb.core

        if self._in is None:
            raise TransportLost(f"{self.where} is not open")
        try:
            # A time-out of zero would wait for ever.
            return bytes(self._in.read(_USB_READ_BYTES, timeout=max(1, round(timeout_s * 1000))))
        except usb.core.USBTimeoutError:
            return b""
        except usb.core.USBError as error:
            raise self._lost_error(error) from error

    def _lost_error(self, error: Exception) -> TransportLost:
        return TransportLost(
            f"lost {self.where} ({error}); is the cable plugged in and the controller switched on?"
        )


#: Address of an emulated controller, ``HOST:PORT``; overrides the configuration, for tests with an emulator.
ADDRESS_VARIABLE = "ESCAPE_E727"


def make_transport(
    wire: WireConfig, serial: str, options: Mapping[str, object], context: DeviceContext
) -> Transport:
    """The wire that ``wire`` names, or :data:`ADDRESS_VARIABLE`; not open.

    ``options`` are those of an emulator.

    Raises
    ------
    ConfigError
        An emulator is requested and none is installed, or the environment has no address.
    """
    if address := os.environ.get(ADDRESS_VARIABLE):
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise ConfigError(f"{ADDRESS_VARIABLE}={address}: write HOST:PORT, or unset it")
        return TcpTransport(host, int(port), wire.connect_s, wire.timeout_s)
    if options and wire.kind != "emulator":
        raise ConfigError(
            f"devices.modulator.options: {', '.join(options)}: read with wire.kind = 'emulator' only; remove"
        )
    if wire.kind == "tcp":
        return TcpTransport(wire.host, wire.port, wire.connect_s, wire.timeout_s)
    if wire.kind == "serial":
        return SerialTransport(wire.serial_port, wire.baud, wire.timeout_s)
    if wire.kind == "usb":
        return UsbTransport(wire.usb_vendor, wire.usb_product, serial, wire.timeout_s)
    from escape_hw.api.emulator import EmulatorRequest
    from escape_hw.config.registry import emulator_factory

    words = {"serial": serial, **{key: str(value) for key, value in options.items()}}
    shared = None if context.system is None else context.shared
    request = EmulatorRequest("127.0.0.1", 0, False, words, shared, context.system)
    return EmulatedTransport(emulator_factory("e727")(request), wire.connect_s, wire.timeout_s)


class EmulatedTransport(TcpTransport):
    """The network wire to an emulator in this process, which lives as long as the connection."""

    def __init__(self, emulator: Emulator, connect_s: float, timeout_s: float) -> None:
        super().__init__("", 0, connect_s, timeout_s)
        self._emulator = emulator
        self.where = "emulator"

    def open(self) -> None:
        """Start the emulator and connect to it."""
        host, _, port = self._emulator.start().removeprefix("tcp ").rpartition(":")
        self._address = host, int(port)
        super().open()

    def close(self) -> None:
        """Disconnect and stop the emulator."""
        super().close()
        self._emulator.stop()
