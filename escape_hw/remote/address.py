"""Where servers listen: one file for each in a folder of the user's own, and what addresses look like."""

from __future__ import annotations

import contextlib
import json
import os
import re
import stat
import tempfile
from dataclasses import asdict, dataclass
from pathlib import Path

import platformdirs

from escape_hw.errors import ConfigError, ServerGone, StorageError
from escape_hw.io.storage import storage_error, write_atomic
from escape_hw.supervision import is_alive

#: Longest path of a local socket, the system's own limit (with room for its end).
_LONGEST_SOCKET = 100
_TCP = re.compile(r"tcp://(?P<host>[^/:]+|\[[0-9a-fA-F:]+\]):(?P<port>\d{1,5})")
#: Addresses that stay on this machine.
_LOOPBACK = re.compile(r"127\.\d+\.\d+\.\d+|localhost|\[::1\]")


@dataclass(frozen=True, slots=True)
class Endpoint:
    """Where a server takes requests and tells events, as ZeroMQ writes addresses."""

    requests: str
    events: str


@dataclass(frozen=True, slots=True)
class ServerListing:
    """A server on this machine.

    Parameters
    ----------
    system
        The system that it serves.
    pid, started
        Its process, and when that began in clock ticks after boot.
    requests, events
        Its local sockets.
    tcp
        Address for other users and machines, ``tcp://host:port``; empty: none.
    """

    system: str
    pid: int
    started: int
    requests: str
    events: str
    tcp: str = ""

    @property
    def alive(self) -> bool:
        """Whether that very process lives."""
        return is_alive(self.pid, self.started)


def runtime_folder() -> Path:
    """The user's own folder for sockets and listings, made when it is not there.

    Raises
    ------
    StorageError
        It cannot be made, or others could write into it.
    """
    folder = Path(platformdirs.user_runtime_dir("escape", appauthor=False))
    try:
        folder.mkdir(parents=True, exist_ok=True, mode=0o700)
        status = folder.stat()
    except OSError as error:
        raise storage_error(folder, error) from error
    if status.st_uid != os.getuid() or stat.S_IMODE(status.st_mode) & 0o022:
        raise StorageError(f"{folder}: others may write there; remove it, or set XDG_RUNTIME_DIR")
    return folder


def local_endpoint(system: str, pid: int) -> Endpoint:
    """Local sockets for a server, which only this user can reach."""
    folder = runtime_folder()
    if len(str(folder)) + len(system) + 20 > _LONGEST_SOCKET:
        folder = Path(tempfile.mkdtemp(prefix="escape-"))
    base = folder / f"{system}-{pid}"
    return Endpoint(f"ipc://{base}.req", f"ipc://{base}.pub")


def register_server(listing: ServerListing) -> Path:
    """Write down that a server listens; readable for this user only.

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
    """Take a server's listing and sockets away, if they are still its own."""
    if find_server(listing.system) == listing:
        (runtime_folder() / f"{listing.system}.json").unlink(missing_ok=True)
    for address in (listing.requests, listing.events):
        path = Path(address.removeprefix("ipc://"))
        path.unlink(missing_ok=True)
        if path.parent.name.startswith("escape-"):
            with contextlib.suppress(OSError):
                path.parent.rmdir()


def find_server(system: str) -> ServerListing | None:
    """What is written down of a system's server, be it alive or dead."""
    try:
        return ServerListing(**json.loads((runtime_folder() / f"{system}.json").read_bytes()))
    except (OSError, ValueError, TypeError):
        return None


def running_servers() -> tuple[ServerListing, ...]:
    """The servers of this user that live on this machine."""
    found = (find_server(path.stem) for path in sorted(runtime_folder().glob("*.json")))
    return tuple(one for one in found if one is not None and one.alive)


def tcp_endpoint(host: str, port: int) -> Endpoint:
    """Addresses of a server on a network: events come from the port after that of the requests."""
    return Endpoint(f"tcp://{host}:{port}", f"tcp://{host}:{port + 1}")


def is_loopback(host: str) -> bool:
    """Whether an address stays on this machine."""
    return _LOOPBACK.fullmatch(host) is not None


def resolve(name: str) -> Endpoint:
    """Where to reach a server.

    Parameters
    ----------
    name
        ``tcp://host:port``, or the name of a system that is served on this machine.

    Raises
    ------
    ConfigError
        It means nothing.
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
