"""Finds devices without opening them."""

from __future__ import annotations

import importlib.metadata
import os
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import cast

from escape_hw.api.discovery import Discoverer, Found
from escape_hw.runtime.host import Host, SerialLine, UsbDevice

GROUP = "escape.discover"
#: What is known of USB devices by vendor: kind, driver, section.
_USB = {
    "20f7": ("camera", "ximea", "wfs"),
    "1e10": ("camera", "aravis", "science"),
    "1724": ("camera", "aravis", "science"),
    "1a72": ("modulator", "pi-e727", "modulator"),
}
#: Vendors of serial lines that a controller of PI's may be behind.
_SERIAL = ("0403", "1a72")
#: Where ALPAO's SDK looks for the files of a mirror.
_ALPAO_VARIABLES = ("ACECFG", "ACEROOT")


def discover(hosts: Sequence[str] = (), host: Host | None = None) -> list[Found]:
    """Everything that can be seen.

    Parameters
    ----------
    hosts
        Computers to ask for devices on the network, ``name`` or ``name:port``; the network is never
        searched through.
    host
        This computer.
    """
    host = host or Host()
    found = [*_on_usb(host), *_on_serial_lines(host), *_alpao_folders(host)]
    for entry in sorted(importlib.metadata.entry_points(group=GROUP), key=lambda one: one.name):
        found += cast(Discoverer, entry.load())(hosts)
    return found


def _on_usb(host: Host) -> Iterator[Found]:
    for device in host.usb_devices():
        if device.vendor in _USB:
            kind, driver, section = _USB[device.vendor]
            wire = '\n\n[devices.modulator.wire]\nkind = "usb"' if driver == "pi-e727" else ""
            yield _found(host, kind, driver, section, device, device.path, wire)


def _on_serial_lines(host: Host) -> Iterator[Found]:
    for line in host.serial_lines():
        if line.usb.vendor in _SERIAL:
            yield _found(host, "modulator", "pi-e727", "modulator", line.usb, line.path, _line_toml(line))


def _line_toml(line: SerialLine) -> str:
    stable = f"/dev/escape/serial-{line.usb.serial}" if line.usb.serial else line.path
    return f'\n\n[devices.modulator.wire]\nkind = "serial"\nserial_port = "{stable}"'


def _found(
    host: Host, kind: str, driver: str, section: str, device: UsbDevice, path: str, more: str
) -> Found:
    model = " ".join(word for word in (device.manufacturer, device.name) if word)
    return Found(
        kind, model or f"{device.vendor}:{device.product}", device.serial, path, driver,
        tuple(host.users_of(path)), paste(section, driver, device.serial) + more,
    )  # fmt: skip


def paste(section: str, driver: str, serial: str) -> str:
    """Lines of a device's section."""
    return f'[devices.{section}]\nmode = "hardware"\ndriver = "{driver}"\nserial = "{serial}"'


def _alpao_folders(host: Host) -> Iterator[Found]:
    """Mirrors whose files are there; the SDK tells only by opening them whether they are, too."""
    for variable in _ALPAO_VARIABLES:
        if not os.environ.get(variable):
            continue
        root = Path(os.environ[variable])
        for file in sorted({*root.glob("*.acfg"), *(root / "config").glob("*.acfg")}):
            toml = paste("dm", "alpao", file.stem)
            toml += f'\n\n[devices.dm.options]\nconfig_folder = "{file.parent}"'
            users = tuple(host.users_of(str(file)))
            yield Found("deformable mirror", "ALPAO", file.stem, str(file), "alpao", users, toml)
