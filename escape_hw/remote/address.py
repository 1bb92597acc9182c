"""Addresses of servers, and the user's list of running servers (one file each)."""

from __future__ import annotations

import contextlib
import json
import os
import re
import stat
import tempfile
import warnings
from dataclasses import asdict, dataclass
from pathlib import Path

import platformdirs

from escape_hw.errors import ConfigError, ServerGone, StorageError
from escape_hw.io.storage import storage_error, write_atomic
from escape_hw.supervision import is_alive

#: Longest path of a local socket, with a margin to the system's limit of 107 bytes.
_LONGEST_SOCKET = 100
_TCP = re.compile(r"tcp://(?P<host>[^/:]+|\[[0-9a-fA-F:]+\]):(?P<port>\d{1,5})")
#: Addresses of this computer.
_LOOPBACK = re.compile(r"127\.\d+\.\d+\.\d+|localhost|\[::1\]")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """ZeroMQ addresses of a server's requests and events."""

    requests: str
    events: str


@dataclass(frozen=True, slots=True)
class ServerListing:
    """A server on this computer.

    Parameters
    ----------
    system
        Name of the system.
    pid, started
        Process of the server, and its start time in clock ticks after boot.
    requests, events
        Local sockets.
    tcp
        Address for other users and computers, ``tcp://host:port``; empty without one.
    """

    system: str
    pid: int
    started: int
    requests: str
    events: str
    tcp: str = ""

    @property
    def alive(self) -> bool:
        """Whether the process is alive."""
        return is_alive(self.pid, self.started)


def runtime_folder() -> Path:
    """The user's folder for sockets and listings; created when missing.

    Raises
    ------
    StorageError
        It cannot be created, belongs to another user, or other users can write to it.
    """
    try:
        # platformdirs warns of a folder that the login session did not make; see below for what is refused.
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            folder = Path(platformdirs.user_runtime_dir("escape", appauthor=False))
    except OSError as error:
        # Its text names the folder, and XDG_RUNTIME_DIR as the remedy.
        raise StorageError(str(error)) from error
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        status = folder.stat()
    except OSError as error:
        raise storage_error(folder, error) from error
    if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o022:
        raise StorageError(f"{folder}: other users can write there; remove it, or set XDG_RUNTIME_DIR")
    return folder


def local_endpoint(system: str, pid: int) -> Endpoint:
    """Local sockets of a server, which only this user can reach."""
    folder = runtime_folder()
    if len(str(folder)) + len(system) + 20 > _LONGEST_SOCKET:
        folder = Path(tempfile.mkdtemp(prefix="escape-"))
    base = folder / f"{system}-{pid}"
    return Endpoint(f"ipc://{base}.req", f"ipc://{base}.pub")


def register_server(listing: ServerListing) -> Path:
    """Write the listing of a server, readable for this user only.

    Raises
    ------
    StorageError
        It cannot be written.
    """
    path = runtime_folder() / f"{listing.system}.json"
    write_atomic(path, json.dumps(asdict(listing)).encode())
    path.chmod(0o600)
    return path


def unregister_server(listing: ServerListing) -> None:
    """Remove the listing, if it is still this server's, and the sockets."""
    if find_server(listing.system) == listing:
        (runtime_folder() / f"{listing.system}.json").unlink(missing_ok=True)
    for address in (listing.requests, listing.events):
        path = Path(address.removeprefix("ipc://"))
        path.unlink(missing_ok=True)
        if path.parent.name.startswith("escape-"):
            with contextlib.suppress(OSError):
                path.parent.rmdir()


def find_server(system: str) -> ServerListing | None:
    """Listing of a system's server, alive or not; ``None`` without one."""
    try:
        return ServerListing(**json.loads((runtime_folder() / f"{system}.json").read_bytes()))
    except (OSError, ValueError, TypeError):
        return None


def running_servers() -> tuple[ServerListing, ...]:
    """Running servers of this user on this computer."""
    found = (find_server(path.stem) for path in sorted(runtime_folder().glob("*.json")))
    return tuple(one for one in found if one is not None and one.alive)


def tcp_endpoint(host: str, port: int) -> Endpoint:
    """TCP addresses of a server; events use the port after that of the requests."""
    return Endpoint(f"tcp://{host}:{port}", f"tcp://{host}:{port + 1}")


def is_loopback(host: str) -> bool:
    """Whether an address belongs to the loopback interface."""
    return _LOOPBACK.fullmatch(host) is not None


def resolve(name: str) -> Endpoint:
    """Find the addresses of a server.

    Parameters
    ----------
    name
        ``tcp://host:port``, or the name of a system that is served on this computer.

    Raises
    ------
    ConfigError
        The address is malformed.
    ServerGone
        No server of that system runs here.
    """
    if "://" in name:
        match = _TCP.fullmatch(name)
        if match is None or not 0 < int(match["port"]) < 65535:
            raise ConfigError(f"{name!r} is no address; write tcp://HOST:PORT, or the name of a system")
        return tcp_endpoint(match["host"], int(match["port"]))
    listing = find_server(name)
    if listing is None or not listing.alive:
        running = ", ".join(one.system for one in running_servers()) or "none"
        raise ServerGone(
            f"no server of '{name}' runs here (running: {running}); start one with 'escape serve {name}'"
        )
    return Endpoint(listing.requests, listing.events)
