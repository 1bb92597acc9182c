"""Discovery of devices without opening them."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast

from escape_hw.api.discovery import DiscoveredDevice, Discoverer, device_section_toml
from escape_hw.errors import ConfigError
from escape_hw.runtime.host.computer import Host, UsbDevice

GROUP = "escape.discover"
#: Kind, driver and section of USB devices, by vendor number.
_USB = {
    "20f7": ("camera", "ximea", "wfs"),
    "1e10": ("camera", "aravis", "science"),
    "1724": ("camera", "aravis", "science"),
    "1a72": ("modulator", "pi-e727", "modulator"),
}
#: Vendors of serial adapters that a PI controller may use.
_SERIAL = ("0403", "1a72")
#: Variables with the folder of a mirror's files, as in ALPAO's SDK.
_ALPAO_VARIABLES = ("ACECFG", "ACEROOT")


def discover(hosts: Sequence[str] = (), host: Host | None = None) -> list[DiscoveredDevice]:
    """Devices on USB, on serial lines, with ALPAO files, and those that drivers find on the given hosts.

    ``hosts`` are queried as ``name`` or ``name:port``; the network is never scanned.

    Raises
    ------
    ConfigError
        A host has neither form.
    """
    for where in hosts:
        _require_host(where)
    host = host or Host()
    found = [*_find_usb(host), *_find_serial(host), *_find_alpao(host)]
    for entry in sorted(importlib.metadata.entry_points(group=GROUP), key=lambda one: one.name):
        found += cast(Discoverer, entry.load())(hosts)
    return found


def _require_host(where: str) -> None:
    name, colon, port = where.partition(":")
    is_port = port.isdecimal() and 1 <= int(port) <= 65535
    if not name.strip() or (colon and not is_port):
        raise ConfigError(f"--host {where!r}: write NAME or NAME:PORT, with a port from 1 to 65535")


def _find_usb(host: Host) -> Iterator[DiscoveredDevice]:
    for device in host.usb_devices():
        if device.vendor in _USB:
            kind, driver, section = _USB[device.vendor]
            wire = '\n\n[devices.modulator.wire]\nkind = "usb"' if driver == "pi-e727" else ""
            yield _describe(host, kind, driver, section, device, device.path, wire)


def _find_serial(host: Host) -> Iterator[DiscoveredDevice]:
    for line in host.serial_lines():
        if line.usb.vendor in _SERIAL:
            stable = f"/dev/escape/serial-{line.usb.serial}" if line.usb.serial else line.path
            wire = f'\n\n[devices.modulator.wire]\nkind = "serial"\nserial_port = "{stable}"'
            yield _describe(host, "modulator", "pi-e727", "modulator", line.usb, line.path, wire)


def _describe(
    host: Host, kind: str, driver: str, section: str, device: UsbDevice, path: str, more: str
) -> DiscoveredDevice:
    model = " ".join(word for word in (device.manufacturer, device.name) if word)
    return DiscoveredDevice(
        kind, model or f"{device.vendor}:{device.product}", device.serial, path, driver,
        tuple(host.users_of(path)), device_section_toml(section, driver, device.serial) + more,
    )  # fmt: skip


def _find_alpao(host: Host) -> Iterator[DiscoveredDevice]:
    """Mirrors with a configuration file; whether they are connected is known only when they are opened."""
    for variable in _ALPAO_VARIABLES:
        if not os.environ.get(variable):
            continue
        root = Path(os.environ[variable])
        for file in sorted({*root.glob("*.acfg"), *(root / "config").glob("*.acfg")}):
            toml = device_section_toml("dm", "alpao", file.stem)
            toml += f'\n\n[devices.dm.options]\nconfig_folder = "{file.parent}"'
            users = tuple(host.users_of(str(file)))
            yield DiscoveredDevice("deformable mirror", "ALPAO", file.stem, str(file), "alpao", users, toml)
