"""Chooses the wire to a PI controller from the configuration."""

from __future__ import annotations

import os
from typing import TYPE_CHECKING

from escape_drivers.pi_transports import SerialTransport, TcpTransport, Transport, WireLost
from escape_drivers.pi_usb import UsbTransport
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.api.emulator import Emulator
    from escape_hw.config.device_models import ModulatorConfig
    from escape_hw.config.models import SystemConfig

#: Where an emulated controller listens, ``HOST:PORT``; goes before the configuration, for rehearsals.
ENVIRONMENT = "ESCAPE_E727"
#: Name of the emulator in the group ``escape.emulators``.
_EMULATOR = "e727"


def make_transport(section: ModulatorConfig, config: SystemConfig, shared: dict[str, object]) -> Transport:
    """The wire that ``devices.modulator.wire`` names, or :data:`ENVIRONMENT`; not open.

    Parameters
    ----------
    section
        The modulator's configuration.
    config, shared
        The whole one and the opened system's dictionary, for an emulator that joins the system's twins.

    Raises
    ------
    ConfigError
        An emulator is asked for and none is installed, or the environment holds no address.
    """
    wire = section.wire
    if address := os.environ.get(ENVIRONMENT):
        host, _, port = address.rpartition(":")
        if not host or not port.isdigit():
            raise ConfigError(f"{ENVIRONMENT}={address}: write HOST:PORT, or unset it")
        return TcpTransport(host, int(port), wire.connect_s, wire.timeout_s)
    if section.options and wire.kind != "emulator":
        raise ConfigError(
            f"devices.modulator.options: {', '.join(section.options)}: read with wire.kind = "
            "'emulator' only; remove"
        )
    if wire.kind == "tcp":
        return TcpTransport(wire.host, wire.port, wire.connect_s, wire.timeout_s)
    if wire.kind == "serial":
        return SerialTransport(wire.serial_port, wire.baud, wire.timeout_s)
    if wire.kind == "usb":
        return UsbTransport(wire.usb_vendor, wire.usb_product, section.serial, wire.timeout_s)
    from escape_hw.api.emulator import EmulatorRequest
    from escape_hw.config.registry import emulator_factory

    options = {"serial": section.serial, **{key: str(value) for key, value in section.options.items()}}
    request = EmulatorRequest("127.0.0.1", 0, False, options, shared, config)
    return EmulatedTransport(emulator_factory(_EMULATOR)(request), wire.connect_s, wire.timeout_s)


class EmulatedTransport:
    """The network wire to an emulator in this process, which lives as long as the connection.

    Parameters
    ----------
    emulator
        Not started.
    connect_s, timeout_s
        As of :class:`~escape_drivers.pi_transports.TcpTransport`.
    """

    def __init__(self, emulator: Emulator, connect_s: float, timeout_s: float) -> None:
        self._emulator, self._times = emulator, (connect_s, timeout_s)
        self._wire: TcpTransport | None = None
        self.where = "emulator"

    def open(self) -> None:
        """Start the emulator and connect to it."""
        host, _, port = self._emulator.start().removeprefix("tcp ").rpartition(":")
        self._wire = TcpTransport(host, int(port), *self._times)
        self._wire.open()

    def close(self) -> None:
        """Disconnect and stop the emulator."""
        if self._wire is not None:
            self._wire.close()
            self._wire = None
        self._emulator.stop()

    def write(self, data: bytes) -> None:
        """Send all of it."""
        self._connected().write(data)

    def read(self, timeout_s: float) -> bytes:
        """What has arrived."""
        return self._connected().read(timeout_s)

    def _connected(self) -> TcpTransport:
        if self._wire is None:
            raise WireLost("the emulator is not connected")
        return self._wire
