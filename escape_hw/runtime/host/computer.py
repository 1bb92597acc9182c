"""Properties of this computer, read from the kernel's files."""

from __future__ import annotations

import fcntl
import grp
import os
import pwd
import resource
import socket
import struct
from dataclasses import dataclass
from pathlib import Path

#: ``ioctl`` that asks for an interface's address (linux/sockios.h).
_SIOCGIFADDR = 0x8915


@dataclass(frozen=True, slots=True)
class UsbDevice:
    """A USB device: numbers of vendor and product, texts, and its file."""

    vendor: str
    product: str
    manufacturer: str
    name: str
    serial: str
    path: str


@dataclass(frozen=True, slots=True)
class SerialLine:
    """A serial line over USB: its file, the device behind it and the chip's latency in milliseconds."""

    path: str
    usb: UsbDevice
    latency_ms: int | None


class Host:
    """Reader of a computer's ``/sys``, ``/proc`` and ``/dev`` below a root folder."""

    def __init__(self, root: Path = Path("/")) -> None:
        self.root = root

    def text(self, path: str) -> str | None:
        """Text of a file, stripped; ``None`` when it cannot be read."""
        try:
            return (self.root / path).read_text(encoding="utf-8", errors="replace").strip()
        except OSError:
            return None

    # ------------------------------------------------------------------ limits
    def usbfs_mb(self) -> int | None:
        """Memory for USB transfers in megabytes, 0 without limit; ``None`` without USB."""
        value = self.text("sys/module/usbcore/parameters/usbfs_memory_mb")
        return int(value) if value is not None and value.isdigit() else None

    def governors(self) -> set[str]:
        """Frequency governors of the processors; empty on virtual machines."""
        folder = self.root / "sys/devices/system/cpu"
        files = folder.glob("cpu[0-9]*/cpufreq/scaling_governor")
        return {word for file in files if (word := self.text(str(file.relative_to(self.root))))}

    def real_time_limits(self) -> tuple[int, int]:
        """Highest real-time priority and bytes of locked memory of this user; -1: unlimited."""
        return (
            resource.getrlimit(resource.RLIMIT_RTPRIO)[1],
            resource.getrlimit(resource.RLIMIT_MEMLOCK)[1],
        )

    def available_memory(self) -> int | None:
        """Bytes of memory that programs may still take; ``None`` where the kernel does not say."""
        for line in (self.text("proc/meminfo") or "").splitlines():
            name, _, value = line.partition(":")
            if name == "MemAvailable":
                return 1024 * int(value.split()[0])
        return None

    def groups(self) -> set[str]:
        """Groups of this process."""
        names = set()
        for number in {*os.getgroups(), os.getegid()}:
            try:
                names.add(grp.getgrgid(number).gr_name)
            except KeyError:
                names.add(str(number))
        return names

    # ------------------------------------------------------------------ devices
    def usb_devices(self) -> list[UsbDevice]:
        """USB devices, sorted by file."""
        folder = self.root / "sys/bus/usb/devices"
        found = (
            self._read_usb_device(path) for path in sorted(folder.glob("*")) if (path / "idVendor").is_file()
        )
        return sorted(found, key=lambda device: device.path)

    def _read_usb_device(self, folder: Path) -> UsbDevice:
        def read(name: str) -> str:
            return self.text(str((folder / name).relative_to(self.root))) or ""

        bus, number = int(read("busnum") or 0), int(read("devnum") or 0)
        return UsbDevice(
            read("idVendor"), read("idProduct"), read("manufacturer"), read("product"), read("serial"),
            f"/dev/bus/usb/{bus:03d}/{number:03d}",
        )  # fmt: skip

    def serial_lines(self) -> list[SerialLine]:
        """Serial lines over USB."""
        lines = []
        for tty in sorted((self.root / "sys/class/tty").glob("ttyUSB*")):
            device_folder = tty.resolve()
            usb = next((up for up in device_folder.parents if (up / "idVendor").is_file()), None)
            if usb is not None:
                value = self.text(f"sys/bus/usb-serial/devices/{tty.name}/latency_timer")
                latency = int(value) if value is not None and value.isdigit() else None
                lines.append(SerialLine(f"/dev/{tty.name}", self._read_usb_device(usb), latency))
        return lines

    def users_of(self, path: str) -> list[str]:
        """Processes with a file open, as ``name (pid)``; those of other users only for root."""
        wanted = os.path.realpath(self.root / path.lstrip("/"))
        users = []
        for process in sorted((self.root / "proc").glob("[0-9]*")):
            try:
                links = [os.path.realpath(link) for link in (process / "fd").iterdir()]
            except OSError:
                continue  # ended meanwhile, or another user's
            if wanted in links:
                name = self.text(f"proc/{process.name}/comm") or "?"
                users.append(f"{name} ({process.name})")
        return users


def user_name() -> str:
    """Name of this user, or its number."""
    try:
        return pwd.getpwuid(os.getuid()).pw_name
    except KeyError:
        return str(os.getuid())


def route_to(host: str, port: int) -> tuple[str, str]:
    """Local address and interface of the route to a host; nothing is sent.

    Raises
    ------
    OSError
        The name is unknown, or there is no route.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.connect((host, port))
        address = str(probe.getsockname()[0])
        for _, name in socket.if_nameindex():
            request = struct.pack("256s", name.encode()[:15])
            try:
                answer = fcntl.ioctl(probe.fileno(), _SIOCGIFADDR, request)
            except OSError:
                continue  # no address
            if socket.inet_ntoa(answer[20:24]) == address:
                return address, name
    return address, ""
