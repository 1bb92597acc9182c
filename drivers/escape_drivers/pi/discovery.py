"""Finds PI controllers on given hosts.

A controller serves one client, so the connection is closed at once.
"""

from __future__ import annotations

from collections.abc import Sequence

from escape_drivers.common.discovery import HOST_TIMEOUT_S, probe_hosts
from escape_drivers.pi.controller import E727
from escape_drivers.pi.link import GcsLink
from escape_drivers.pi.transports import TcpTransport
from escape_hw.api.discovery import DiscoveredDevice, device_section_toml

#: Port that a controller listens on unless the host is given with another.
DEFAULT_PORT = 50000


def discover(hosts: Sequence[str]) -> list[DiscoveredDevice]:
    """Entry point ``pi-e727`` of ``escape.discover``: an identity question and nothing else."""
    return probe_hosts(hosts, DEFAULT_PORT, _probe)


def _probe(where: str, host: str, port: int) -> DiscoveredDevice:
    link = GcsLink(where, TcpTransport(host, port, HOST_TIMEOUT_S, HOST_TIMEOUT_S), HOST_TIMEOUT_S)
    try:
        link.open()
    finally:
        link.close()
    return _make_entry(host, port, E727(link, ("1", "2")))


def _make_entry(host: str, port: int, controller: E727) -> DiscoveredDevice:
    toml = device_section_toml("modulator", "pi-e727", controller.serial)
    toml += f'\n\n[devices.modulator.wire]\nkind = "tcp"\nhost = "{host}"\nport = {port}'
    return DiscoveredDevice(
        "modulator", controller.model, controller.serial, f"{host}:{port}", "pi-e727", (), toml
    )
