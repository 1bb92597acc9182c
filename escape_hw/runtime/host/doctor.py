"""Looks whether this computer can do what real devices need."""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.metadata
import os
import re
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, cast

from escape_hw.errors import ConfigError
from escape_hw.runtime.host import udev
from escape_hw.runtime.host.computer import Host, route_to, user_name

if TYPE_CHECKING:
    from escape_hw.api.discovery import NativeLibrary
    from escape_hw.config.devices import DeviceConfig
    from escape_hw.config.system import SystemConfig

Level = Literal["ok", "info", "warning", "error"]

#: Group of the vendors' libraries, by driver (:class:`~escape_hw.api.discovery.NativeLibrary`).
LIBRARIES = "escape.libraries"
#: Where drivers look for their device unless their section says otherwise.
DEFAULT_ADDRESSES = {"asm": ("127.0.0.1", 7336)}
#: Port that is asked about where only the way matters.
_DISCARD = 9
#: Python packages whose versions are worth telling.
PACKAGES = ("numpy", "scipy", "numba", "astropy", "pyserial", "pyusb")
#: Least memory for USB3 cameras, megabytes, and least free space for products, gigabytes.
USBFS_MB, FREE_GB = 1000, 5.0
#: Least real-time priority for the threads of the loop.
MIN_PRIORITY = 90


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that was looked at.

    Parameters
    ----------
    item
        What was looked at.
    level
        ``ok``, ``info`` (told, not judged), ``warning`` (works, but not well) or ``error`` (will not work).
    text
        What was found.
    way_out
        What to do about it; empty where nothing is to be done.
    """

    item: str
    level: Level
    text: str
    way_out: str = ""


def check_computer(
    config: SystemConfig | None, host: Host | None = None, data: Path | None = None
) -> list[Finding]:
    """Look at everything.

    Parameters
    ----------
    config
        A system: what its real devices need becomes an error where it is missing. Without one every
        driver is looked at, and what is missing is only told.
    host
        The computer; this one by default.
    data
        Folder that products go to; the user's by default.
    """
    host = host or Host()
    hardware = _hardware_sections(config)
    return [
        *_check_packages(),
        *_check_libraries(hardware),
        *_check_permissions(host, hardware),
        *_check_usb(host, hardware),
        *_check_serial(host),
        *_check_processor(host),
        *_check_network(hardware),
        *_check_disk_space(data or _data_folder()),
    ]


def exit_code(findings: list[Finding]) -> int:
    """0: all is well; 1: something is not as it should be; 2: something will not work."""
    levels = {finding.level for finding in findings}
    return 2 if "error" in levels else 1 if "warning" in levels else 0


def _hardware_sections(config: SystemConfig | None) -> dict[str, DeviceConfig] | None:
    """Sections of the system's real devices by driver; ``None``: no system was named."""
    if config is None:
        return None
    from escape_hw.bench import resolve_mode
    from escape_hw.config.devices import DeviceConfig

    sections = [section for _, section in config.devices if isinstance(section, DeviceConfig)]
    return {s.driver: s for s in sections if s.driver and resolve_mode(s, config) == "hardware"}


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


# --------------------------------------------------------------------- vendor libraries
def _check_libraries(hardware: dict[str, DeviceConfig] | None) -> Iterator[Finding]:
    for entry in sorted(importlib.metadata.entry_points(group=LIBRARIES), key=lambda one: one.name):
        driver = entry.name
        if hardware is not None and driver not in hardware:
            continue
        library = cast("NativeLibrary", entry.load())
        option = "" if hardware is None else str(hardware[driver].options.get("library", ""))
        chosen = option or os.environ.get(library.variable, "")
        found, failures = _load_first((chosen,) if chosen else library.default)
        if found:
            yield Finding(library.title, "ok", f"{found} (driver '{driver}')")
            continue
        remedy_text = (
            f"{library.source}; or set {library.variable}, or options.library in its section, to a path"
        )
        level: Level = "info" if hardware is None else "error"
        yield Finding(library.title, level, f"driver '{driver}' cannot load it ({failures})", remedy_text)


def _load_first(names: tuple[str, ...]) -> tuple[str, str]:
    """The file that could be loaded and what went wrong with the others."""
    failures = []
    for name in names:
        try:
            ctypes.CDLL(name)
        except OSError as error:
            failures.append(str(error))
        else:
            return _loaded_file(name), ""
    return "", "; ".join(failures)


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
        yield Finding("devices", "info", "the system has no real devices: nothing below is needed for it")
    groups, user = host.groups(), user_name()
    missing = [group for group in udev.GROUPS if group not in groups] if user != "root" else []
    if missing:
        remedy_text = "; ".join(udev.remaining_commands(user))
        yield Finding("groups", "warning", f"{user} is not in {', '.join(missing)}", remedy_text)
    else:
        yield Finding("groups", "ok", f"{user}: {', '.join(sorted(groups))}")
    try:
        due = [change for change in udev.plan_changes(host.root) if change.condition != "installed"]
    except ConfigError as error:
        yield Finding("udev", "error", str(error))
        return
    if due:
        changes = ", ".join(f"{change.target} {change.condition}" for change in due)
        yield Finding("udev", "warning", changes, "escape udev install")
    else:
        yield Finding("udev", "ok", "rules and limits are installed")


def _check_usb(host: Host, hardware: dict[str, DeviceConfig] | None) -> Iterator[Finding]:
    mb = host.usbfs_mb()
    if mb is None:
        needed = hardware is not None and {"ximea", "aravis"} & set(hardware)
        remedy_text = "cameras need a USB port; a virtual machine must be given one" if needed else ""
        yield Finding("usbfs memory", "error" if needed else "info", "this computer has no USB", remedy_text)
    elif 0 < mb < USBFS_MB:
        remedy_text = (
            "escape udev install, then restart; or usbcore.usbfs_memory_mb=1000 on the kernel's command line"
        )
        yield Finding("usbfs memory", "warning", f"{mb} MB; USB3 cameras stall below {USBFS_MB}", remedy_text)
    else:
        yield Finding("usbfs memory", "ok", f"{mb} MB" if mb else "without limit")


def _check_serial(host: Host) -> Iterator[Finding]:
    for line in host.serial_lines():
        item = f"latency of {line.path}"
        if line.latency_ms is None:
            yield Finding(item, "info", "its chip has no latency timer")
        elif line.latency_ms > 1:
            text = f"{line.latency_ms} ms on every answer of {line.usb.name or line.usb.serial}"
            yield Finding(item, "warning", text, "escape udev install, then plug it in again")
        else:
            yield Finding(item, "ok", f"{line.latency_ms} ms")


def _check_processor(host: Host) -> Iterator[Finding]:
    governors = host.governors()
    if not governors:
        yield Finding("governor", "info", "the processors' frequency is not set here (a virtual machine?)")
    elif governors != {"performance"}:
        remedy_text = "sudo cpupower frequency-set --governor performance"
        yield Finding(
            "governor", "warning", f"{', '.join(sorted(governors))}: frames will jitter", remedy_text
        )
    else:
        yield Finding("governor", "ok", "performance")
    priority, memory = host.real_time_limits()
    remedy_text = "escape udev install, join the group 'realtime', then log in again"
    if 0 <= priority < MIN_PRIORITY:
        yield Finding(
            "real-time priority", "warning", f"at most {priority}; {MIN_PRIORITY} is wanted", remedy_text
        )
    else:
        yield Finding("real-time priority", "ok", "any" if priority < 0 else str(priority))
    if memory >= 0:
        yield Finding("locked memory", "warning", f"at most {memory / 1e6:.0f} MB", remedy_text)
    else:
        yield Finding("locked memory", "ok", "without limit")


def _check_network(hardware: dict[str, DeviceConfig] | None) -> Iterator[Finding]:
    """The interface towards every real device that has an address."""
    for driver, section in (hardware or {}).items():
        host, port = _address(driver, section)
        if not host or host == "emulator":
            continue
        item = f"network of '{driver}'"
        try:
            address, interface = route_to(host, port)
        except OSError as error:
            yield Finding(item, "error", f"no way leads to {host} ({error})", "check name, address and cable")
            continue
        text = f"{host} by {interface or 'an interface without a name'}, our address {address}"
        yield Finding(item, "ok", text)


def _address(driver: str, section: DeviceConfig) -> tuple[str, int]:
    """Host and port of a device as configured; an empty host where it is not on a network."""
    wire = getattr(section, "wire", None)
    if wire is not None:
        return (wire.host, wire.port) if wire.kind == "tcp" else ("", 0)
    if driver == "alpao":
        return _alpao_address(section), _DISCARD
    host, port = DEFAULT_ADDRESSES.get(driver, ("", 0))
    return str(section.options.get("host", host)), int(section.options.get("port", port))


def _alpao_address(section: DeviceConfig) -> str:
    """The address in the text file that comes with an ALPAO mirror; empty for electronics on a card."""
    folder = str(section.options.get("config_folder", "") or os.environ.get("ACECFG", ""))
    try:
        text = (Path(folder) / f"{section.serial.upper()}.acfg").read_text(errors="replace")
    except OSError:
        return ""  # the library tells when it is opened
    found = re.search(r"\b\d{1,3}(?:\.\d{1,3}){3}\b", text)
    return found[0] if found else ""


def _check_disk_space(folder: Path) -> Iterator[Finding]:
    place = folder
    while not place.exists():
        place = place.parent
    free = shutil.disk_usage(place).free / 1e9
    text = f"{free:.1f} GB in {place}"
    if free < FREE_GB:
        yield Finding("free space", "warning", text, "clear up, or choose another folder with --out")
    else:
        yield Finding("free space", "ok", text)
