"""Checks that this computer is set up for real devices."""

from __future__ import annotations

import ctypes
import importlib.metadata
import importlib.util
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from escape_hw.errors import ConfigError, EscapeError
from escape_hw.runtime.host import udev
from escape_hw.runtime.host.computer import Host, route_to, user_name

if TYPE_CHECKING:
    from escape_hw.api.discovery import VendorLibrary
    from escape_hw.config.devices import DeviceConfig
    from escape_hw.config.system import SystemConfig

Level = Literal["ok", "info", "warning", "error"]

#: Entry points of vendor libraries, by driver (:class:`~escape_hw.api.discovery.VendorLibrary`).
LIBRARIES = "escape.libraries"
#: Default host and port of devices on the network, by driver.
DEFAULT_ADDRESSES = {"asm": ("127.0.0.1", 7336)}
#: Port for a route to a host of which no port is known.
_DISCARD = 9
#: Python packages whose versions are reported.
PACKAGES = ("numpy", "scipy", "numba", "astropy", "pyserial", "pyusb")
#: Least memory for USB3 cameras in megabytes, and least free space for products in gigabytes.
USBFS_MB, FREE_GB = 1000, 5.0
#: Least real-time priority for the threads of the loop.
MIN_PRIORITY = 90


@dataclass(frozen=True, slots=True)
class Finding:
    """Result of one check: what was checked, what was found, and what to do about it (may be empty).

    ``level`` is ``ok``, ``info`` (reported only), ``warning`` (works, but not well) or ``error`` (will not
    work).
    """

    item: str
    level: Level
    text: str
    remedy: str = ""


def check_computer(
    config: SystemConfig | None, host: Host | None = None, data: Path | None = None
) -> list[Finding]:
    """Check packages, settings, vendor libraries, permissions, USB, serial lines, processor, network, disk.

    With a configuration, missing needs of the system's real devices are errors. Without one, every driver is
    checked, and missing libraries are only reported. ``data`` is the folder for products, by default the
    user's.
    """
    host = host or Host()
    hardware = _hardware_sections(config)
    return [
        *_check_packages(),
        *_check_window(),
        *_check_settings(config),
        *_check_libraries(hardware),
        *_check_permissions(host, hardware),
        *_check_usb(host, hardware),
        *_check_serial(host),
        *_check_processor(host),
        *_check_network(hardware),
        *_check_disk_space(data or _data_folder()),
    ]


def exit_code(findings: list[Finding]) -> int:
    """0: no problem; 1: there are warnings; 2: there are errors."""
    levels = {finding.level for finding in findings}
    return 2 if "error" in levels else 1 if "warning" in levels else 0


def _judge(item: str, ok: bool, text: str, remedy: str) -> Finding:
    return Finding(item, "ok", text) if ok else Finding(item, "warning", text, remedy)


def _hardware_sections(config: SystemConfig | None) -> dict[str, DeviceConfig] | None:
    """Sections of the system's real devices by driver; ``None`` without a system."""
    if config is None:
        return None
    return {section.driver: section for _, section in _real_devices(config)}


def _real_devices(config: SystemConfig) -> Iterator[tuple[str, DeviceConfig]]:
    """Keys and sections of the system's real devices."""
    from escape_hw.bench import resolve_mode
    from escape_hw.config.devices import DeviceConfig

    for name, section in config.devices:
        if (
            isinstance(section, DeviceConfig)
            and section.driver
            and resolve_mode(section, config) == "hardware"
        ):
            yield name, section


def _data_folder() -> Path:
    import platformdirs

    return Path(platformdirs.user_data_dir("escape"))


def _check_packages() -> Iterator[Finding]:
    versions = []
    for name in PACKAGES:
        try:
            versions.append(f"{name} {importlib.metadata.version(name)}")
        except importlib.metadata.PackageNotFoundError:
            yield Finding(f"package {name}", "error", "not installed", f"pip install {name}")
    yield Finding("packages", "ok", ", ".join(versions))


#: Libraries that Qt needs for a display (X11), and their packages of Debian and Ubuntu.
QT_LIBRARIES = {
    "libxcb-cursor.so.0": "libxcb-cursor0", "libxcb-icccm.so.4": "libxcb-icccm4",
    "libxcb-image.so.0": "libxcb-image0", "libxcb-keysyms.so.1": "libxcb-keysyms1",
    "libxcb-render-util.so.0": "libxcb-render-util0", "libxcb-shape.so.0": "libxcb-shape0",
    "libxkbcommon-x11.so.0": "libxkbcommon-x11-0",
}  # fmt: skip


def missing_qt_libraries() -> tuple[str, ...]:
    """Packages of the libraries that Qt does not find on this computer."""
    return tuple(package for name, package in QT_LIBRARIES.items() if not _can_load(name))


def _can_load(library: str) -> bool:
    """Whether the dynamic linker finds a library, also in ``LD_LIBRARY_PATH``."""
    try:
        ctypes.CDLL(library)
    except OSError:
        return False
    return True


def _check_window() -> Iterator[Finding]:
    if importlib.util.find_spec("PySide6") is None:
        yield Finding("window", "info", "PySide6 is not installed", "pip install 'escape-hw[gui]'")
        return
    missing = missing_qt_libraries()
    yield _judge(
        "window", not missing, f"Qt misses {', '.join(missing)}" if missing else "Qt has its libraries",
        f"apt install {' '.join(missing)}",
    )  # fmt: skip


def _check_settings(config: SystemConfig | None) -> Iterator[Finding]:
    """Whether mirror and sensor have drivers, and all drivers accept their sections; opens no device."""
    if config is None:
        return
    yield from _check_required_drivers(config)
    from escape_hw.api.device import Device
    from escape_hw.config.registry import DeviceContext, call_factory, device_factory

    shared: dict[str, object] = {}
    for name, section in _real_devices(config):
        try:
            factory = device_factory(section.driver, hardware=True)
            call_factory(f"devices.{name}", Device, factory, section, DeviceContext(name, config, shared))  # type: ignore[type-abstract]
        except EscapeError as error:
            yield Finding(f"devices.{name}", "error", str(error), "correct this section of the system file")


def _check_required_drivers(config: SystemConfig) -> Iterator[Finding]:
    from escape_hw.api.camera import Camera
    from escape_hw.api.mirror import DeformableMirror
    from escape_hw.bench import resolve_mode
    from escape_hw.config.registry import explain_missing_driver

    mirror, sensor = config.devices.dm, config.devices.wfs
    for name, section, kind in (("dm", mirror, DeformableMirror), ("wfs", sensor, Camera)):
        if resolve_mode(section, config) == "hardware" and not section.driver:
            text = "is empty; every system needs this device"
            yield Finding(f"devices.{name}.driver", "error", text, explain_missing_driver(kind))


# --------------------------------------------------------------------- vendor libraries
def _check_libraries(hardware: dict[str, DeviceConfig] | None) -> Iterator[Finding]:
    for entry in sorted(importlib.metadata.entry_points(group=LIBRARIES), key=lambda one: one.name):
        driver = entry.name
        if hardware is not None and driver not in hardware:
            continue
        library: VendorLibrary = entry.load()
        option = "" if hardware is None else str(hardware[driver].options.get("library", ""))
        try:
            found = _loaded_file(str(vars(library.load(option))["_name"]))
        except OSError as error:
            failures = error
        else:
            yield Finding(library.title, "ok", f"{found} (driver '{driver}')")
            continue
        remedy = f"{library.source}; or set {library.variable}, or options.library in its section, to a path"
        level: Level = "info" if hardware is None else "error"
        yield Finding(library.title, level, f"driver '{driver}' cannot load it ({failures})", remedy)


def _loaded_file(name: str) -> str:
    """The file that a loaded library really is: its name holds the version."""
    try:
        maps = Path("/proc/self/maps").read_text(encoding="utf-8", errors="replace")
    except OSError:
        return name
    stem = Path(name).name.split(".so")[0]
    return next((line.split()[-1] for line in maps.splitlines() if f"/{stem}" in line), name)


# --------------------------------------------------------------------- permissions
def _check_permissions(host: Host, hardware: dict[str, DeviceConfig] | None) -> Iterator[Finding]:
    if hardware is not None and not hardware:
        yield Finding("devices", "info", "the system has no real devices: it needs nothing of the following")
    groups, user = host.groups(), user_name()
    missing = [group for group in udev.GROUPS if group not in groups] if user != "root" else []
    text = f"{user} is not in {', '.join(missing)}" if missing else f"{user}: {', '.join(sorted(groups))}"
    yield _judge("groups", not missing, text, "; ".join(udev.remaining_commands(user)))
    try:
        due = [change for change in udev.plan_changes(host.root) if change.condition != "installed"]
    except ConfigError as error:
        yield Finding("udev", "error", str(error))
        return
    changes = ", ".join(f"{change.target} {change.condition}" for change in due)
    yield _judge("udev", not due, changes or "rules and limits are installed", "escape udev install")


def _check_usb(host: Host, hardware: dict[str, DeviceConfig] | None) -> Iterator[Finding]:
    mb = host.usbfs_mb()
    if mb is None:
        needed = hardware is not None and {"ximea", "aravis"} & set(hardware)
        remedy = "cameras need a USB port; a virtual machine must be given one" if needed else ""
        yield Finding("usbfs memory", "error" if needed else "info", "this computer has no USB", remedy)
        return
    text, enough = f"{mb} MB" if mb else "without limit", not 0 < mb < USBFS_MB
    yield _judge(
        "usbfs memory", enough, text if enough else f"{text}; USB3 cameras stall below {USBFS_MB}",
        "escape udev install, then restart; or usbcore.usbfs_memory_mb=1000 on the kernel's command line",
    )  # fmt: skip


def _check_serial(host: Host) -> Iterator[Finding]:
    for line in host.serial_lines():
        item = f"latency of {line.path}"
        if line.latency_ms is None:
            yield Finding(item, "info", "its chip has no latency timer")
            continue
        text, short = f"{line.latency_ms} ms", line.latency_ms <= 1
        text += "" if short else f" on every answer of {line.usb.name or line.usb.serial}"
        yield _judge(item, short, text, "escape udev install, then plug it in again")


def _check_processor(host: Host) -> Iterator[Finding]:
    governors = host.governors()
    if not governors:
        yield Finding("governor", "info", "the processors' frequency is not set here (a virtual machine?)")
    else:
        text, steady = ", ".join(sorted(governors)), governors == {"performance"}
        remedy = "sudo cpupower frequency-set --governor performance"
        yield _judge("governor", steady, text if steady else f"{text}: frames will jitter", remedy)
    priority, memory = host.real_time_limits()
    remedy = "escape udev install, join the group 'realtime', then log in again"
    low = 0 <= priority < MIN_PRIORITY
    text = (
        f"at most {priority}; {MIN_PRIORITY} is needed" if low else "any" if priority < 0 else str(priority)
    )
    yield _judge("real-time priority", not low, text, remedy)
    text = f"at most {memory / 1e6:.0f} MB" if memory >= 0 else "without limit"
    yield _judge("locked memory", memory < 0, text, remedy)


def _check_network(hardware: dict[str, DeviceConfig] | None) -> Iterator[Finding]:
    """The interface of the route to every real device with an address."""
    for driver, section in (hardware or {}).items():
        host, port = _address(driver, section)
        if not host or host == "emulator":
            continue
        item = f"network of '{driver}'"
        try:
            address, interface = route_to(host, port)
        except OSError as error:
            yield Finding(item, "error", f"no route to {host} ({error})", "check name, address and cable")
            continue
        text = f"{host} by {interface or 'an interface without a name'}, our address {address}"
        yield Finding(item, "ok", text)


def _address(driver: str, section: DeviceConfig) -> tuple[str, int]:
    """Configured host and port of a device; an empty host without a network."""
    wire = getattr(section, "wire", None)
    if wire is not None:
        return (wire.host, wire.port) if wire.kind == "tcp" else ("", 0)
    if driver == "alpao":
        return _alpao_address(section), _DISCARD
    host, port = DEFAULT_ADDRESSES.get(driver, ("", 0))
    return str(section.options.get("host", host)), int(section.options.get("port", port))


def _alpao_address(section: DeviceConfig) -> str:
    """The address in the configuration file of an ALPAO mirror; empty for electronics on a card."""
    folder = str(section.options.get("config_folder", "") or os.environ.get("ACECFG", ""))
    try:
        text = (Path(folder) / f"{section.serial.upper()}.acfg").read_text(errors="replace")
    except OSError:
        return ""  # reported by the library when the mirror is opened
    found = re.search(r"\b\d{1,3}(?:\.\d{1,3}){3}\b", text)
    return found[0] if found else ""


def _check_disk_space(folder: Path) -> Iterator[Finding]:
    place = folder
    while not os.path.exists(place):
        place = place.parent
    if place != folder and not os.access(place, os.W_OK | os.X_OK):
        remedy = "set HOME or XDG_DATA_HOME to a folder that you may write, or choose one with --out"
        yield Finding("data folder", "error", f"{folder} cannot be made in {place}", remedy)
    free = shutil.disk_usage(place).free / 1e9
    remedy = "delete files, or choose another folder with --out"
    yield _judge("free space", free >= FREE_GB, f"{free:.1f} GB in {place}", remedy)
