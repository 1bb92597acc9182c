"""USB wire to a PI controller: two bulk endpoints, through pyusb."""

from __future__ import annotations

import contextlib
import logging
from typing import Any

from escape_drivers.pi_transports import WireLost

_SIZE = 16384

log = logging.getLogger(__name__)


class UsbTransport:
    """A controller found by the vendor's number and its serial number.

    Parameters
    ----------
    vendor, product
        USB numbers; ``None``: any product of the vendor's.
    serial
        Serial number that the device's descriptor must end with or contain; empty: the only one there is.
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
            raise WireLost(
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
            found = [one for one in present if self._serial in (one.serial_number or "")]
        except usb.core.NoBackendError as error:
            raise WireLost("pyusb finds no libusb; install libusb-1.0-0") from error
        except (usb.core.USBError, ValueError) as error:
            raise WireLost(
                f"cannot read the serial numbers of {self.where} ({error}); install the udev rules: "
                "'escape udev install'"
            ) from error
        if len(found) != 1:
            seen = ", ".join(one.serial_number or "?" for one in present) or "none of this vendor"
            raise WireLost(
                f"{len(found)} controllers match {self.where} (there: {seen}); set "
                "devices.modulator.serial, or see to cable and power"
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
            # pyusb's word for a backend without kernel drivers: there is none to take the controller from.
            log.debug("%s: this USB backend knows no kernel drivers", self.where)
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
            raise WireLost(
                f"{self.where} has no pair of bulk endpoints; is wire.usb_product the controller's?"
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
            raise WireLost(f"{self.where} is not open")
        padded = data + b"\0" * (len(data) % 2)
        try:
            sent = self._out.write(padded, timeout=round(self._timeout_s * 1000))
        except usb.core.USBError as error:
            raise self._gone(error) from error
        if sent != len(padded):
            raise WireLost(f"{self.where} took {sent} of {len(padded)} bytes; unplug it and plug it in again")

    def read(self, timeout_s: float) -> bytes:
        """What has arrived."""
        import usb.core

        if self._in is None:
            raise WireLost(f"{self.where} is not open")
        try:
            # A time-out of zero would wait for ever.
            return bytes(self._in.read(_SIZE, timeout=max(1, round(timeout_s * 1000))))
        except usb.core.USBTimeoutError:
            return b""
        except usb.core.USBError as error:
            raise self._gone(error) from error

    def _gone(self, error: Exception) -> WireLost:
        return WireLost(
            f"lost {self.where} ({error}); is the cable plugged in and the controller switched on?"
        )
