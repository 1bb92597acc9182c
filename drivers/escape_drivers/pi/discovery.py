"""Finds PI controllers on given hosts.

A controller serves one client, so the connection is closed at once.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence

from escape_drivers.pi.controller import E727
from escape_drivers.pi.link import GcsLink
from escape_drivers.pi.transports import TcpTransport
from escape_hw.api.discovery import DiscoveredDevice
from escape_hw.errors import DeviceError

log = logging.getLogger(__name__)

#: Port that a controller listens on unless the host is given with another.
DEFAULT_PORT = 50000
#: Longest wait for a host, seconds.
_TIMEOUT_S = 1.0


def discover(hosts: Sequence[str]) -> list[DiscoveredDevice]:
    """Entry point ``pi-e727`` of ``escape.discover``: an identity question and nothing else."""
    found = []
    for where in hosts:
        host, _, port = where.partition(":")
        number = int(port) if port.isdigit() else DEFAULT_PORT
        link = GcsLink(where, TcpTransport(host, number, _TIMEOUT_S, _TIMEOUT_S), _TIMEOUT_S)
        try:
            link.open()
        except DeviceError as error:
            log.info("%s", error)
            continue
        finally:
            link.close()
        found.append(_make_entry(host, number, E727(link, ("1", "2"))))
    return found


def _make_entry(host: str, port: int, controller: E727) -> DiscoveredDevice:
    toml = (
        f'[devices.modulator]\nmode = "hardware"\ndriver = "pi-e727"\nserial = "{controller.serial}"\n\n'
        f'[devices.modulator.wire]\nkind = "tcp"\nhost = "{host}"\nport = {port}'
    )
    return DiscoveredDevice(
        "modulator", controller.model, controller.serial, f"{host}:{port}", "pi-e727", (), toml
    )
