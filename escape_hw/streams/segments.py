"""Segments of shared memory: names, owners, and removal after their process has died.

A segment is a mapped file in ``/dev/shm``. It is named only after its header is written, so that no
process sees an incomplete one, and a process that is killed before leaves none. The name contains the
user and the process of the owner; the header contains the start time of that process, since process
numbers are reused.
"""

from __future__ import annotations

import contextlib
import mmap
import os
import re
import struct
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from escape_hw.errors import EscapeError, StorageError
from escape_hw.supervision import is_alive, process_start

#: Folder of the segments.
SHARED = Path("/dev/shm")
#: The first eight bytes of a segment.
MAGIC = int.from_bytes(b"ESCRING\0", "little")
#: Version of the layout; a segment of another version is refused.
SCHEMA = 1
#: Magic, schema, owner's process and its start time; the same in every version of the layout.
IDENTITY = struct.Struct("=QQQQ")

_NAME = re.compile(r"escape-(?P<uid>\d+)-(?P<system>[A-Za-z0-9._-]+)-(?P<pid>\d+)-(?P<stream>[A-Za-z0-9_]+)")


class StreamUnavailable(EscapeError):
    """The memory of a stream does not exist, is closed, or is not valid."""


@dataclass(frozen=True, slots=True)
class Segment:
    """A segment of shared memory.

    Parameters
    ----------
    name
        ``escape-<uid>-<system>-<pid>-<stream>``, a file in :data:`SHARED`.
    pid, started
        Process of the owner, and its start time in clock ticks after boot.
    alive
        Whether that process is alive.
    """

    name: str
    system: str
    stream: str
    pid: int
    started: int
    size: int
    alive: bool


def segment_name(system: str, stream: str) -> str:
    """Name of the segment of a stream of this process."""
    system = re.sub(r"[^A-Za-z0-9._-]", "_", system)
    return f"escape-{os.getuid()}-{system}-{os.getpid()}-{stream}"


def create(name: str, size: int, fill: struct.Struct, *header: int) -> mmap.mmap:
    """Create a segment: allocate its memory, write its header, then link its name.

    Parameters
    ----------
    name
        Name; a segment of that name of a dead process is removed.
    size
        Bytes. They are allocated now, since writing to memory that is not available kills the process.
    fill, header
        Format and values of the layout's part of the header, which follows :data:`IDENTITY`.

    Raises
    ------
    StorageError
        Shared memory is full, or a living process owns a segment of that name.
    """
    path = SHARED / name
    try:
        handle = os.open(SHARED, os.O_TMPFILE | os.O_RDWR | os.O_CLOEXEC, 0o600)
        try:
            os.posix_fallocate(handle, 0, size)
            memory = mmap.mmap(handle, size, flags=mmap.MAP_SHARED | mmap.MAP_POPULATE)
            fill.pack_into(memory, IDENTITY.size, *header)
            IDENTITY.pack_into(memory, 0, MAGIC, SCHEMA, os.getpid(), process_start(os.getpid()) or 0)
            _link_name(handle, path)
        finally:
            os.close(handle)
    except OSError as error:
        raise StorageError(
            f"{path}: {size / 1e6:.1f} MB of shared memory are not available ({error.strerror or error}); "
            "list the segments with 'escape streams', remove those of dead servers with 'escape streams "
            "--reap', or enlarge /dev/shm"
        ) from error
    return memory


def _link_name(handle: int, path: Path) -> None:
    source = f"/proc/self/fd/{handle}"
    # With src_dir_fd, which the absolute path overrides, Python follows the link to the file itself.
    try:
        os.link(source, path, src_dir_fd=handle)
    except FileExistsError:
        found = read_identity(path.name)
        if found is None or found.alive:
            raise
        path.unlink()
        os.link(source, path, src_dir_fd=handle)


def attach(name: str) -> mmap.mmap:
    """Map a segment for reading.

    Raises
    ------
    StreamUnavailable
        It does not exist, belongs to another user, has another version, or is no segment.
    """
    path = SHARED / name
    if not _NAME.fullmatch(name):
        raise StreamUnavailable(
            f"'{name}' is not the name of a segment; 'escape streams' lists the existing ones"
        )
    try:
        handle = os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC)
        try:
            status = os.fstat(handle)
            if status.st_uid not in (os.getuid(), 0):
                raise StreamUnavailable(f"{path} belongs to user {status.st_uid} and is not read")
            memory = mmap.mmap(handle, status.st_size, flags=mmap.MAP_SHARED, prot=mmap.PROT_READ)
        finally:
            os.close(handle)
    except (OSError, ValueError) as error:
        raise StreamUnavailable(f"{path}: no such stream ({error}); has its server ended?") from error
    magic, schema, *_ = IDENTITY.unpack_from(memory) if len(memory) >= IDENTITY.size else (0, 0)
    if (magic, schema) != (MAGIC, SCHEMA):
        memory.close()
        raise StreamUnavailable(
            f"{path} has version {schema}, this program reads version {SCHEMA}; "
            "use the same version of escape-hw as its server"
            if magic == MAGIC
            else f"{path} is not a stream of ESCAPE"
        )
    return memory


def remove(name: str) -> None:
    """Remove the name of a segment; processes that have it mapped keep their mapping."""
    with contextlib.suppress(FileNotFoundError):
        (SHARED / name).unlink()


def read_identity(name: str) -> Segment | None:
    """Name and owner of a segment; ``None`` when it does not exist or is not valid."""
    parts = _NAME.fullmatch(name)
    if parts is None:
        return None
    try:
        with open(SHARED / name, "rb", opener=_no_link) as file:
            head, size = file.read(IDENTITY.size), os.fstat(file.fileno()).st_size
    except OSError:
        return None
    if len(head) < IDENTITY.size or IDENTITY.unpack(head)[0] != MAGIC:
        return None
    _, _, pid, started = IDENTITY.unpack(head)
    alive = is_alive(pid, started)
    return Segment(name, parts["system"], parts["stream"], pid, started, size, alive)


def _no_link(path: str, flags: int) -> int:
    return os.open(path, flags | os.O_NOFOLLOW | os.O_CLOEXEC)


def segments(system: str | None = None, pid: int | None = None) -> tuple[Segment, ...]:
    """Segments of this user; of one system or one process where given."""
    mine = sorted(path.name for path in SHARED.glob(f"escape-{os.getuid()}-*"))
    found = (read_identity(name) for name in mine)
    return tuple(
        one for one in found
        if one is not None and system in (None, one.system) and pid in (None, one.pid)
    )  # fmt: skip


def remove_orphaned(pid: int | None = None) -> tuple[Segment, ...]:
    """Remove the segments of dead processes, of one process or of all; returns them."""
    dead = tuple(one for one in segments(pid=pid) if not one.alive)
    for one in dead:
        remove(one.name)
    return dead


def readers(names: Iterable[str]) -> dict[str, tuple[int, ...]]:
    """Processes of this user that have each segment mapped, without its owner."""
    users: dict[str, list[int]] = {name: [] for name in names}
    for pid in sorted(int(path.name) for path in Path("/proc").iterdir() if path.name.isdigit()):
        for name in _mapped_segments(pid) & users.keys():
            users[name].append(pid)
    owners = {name: read_identity(name) for name in users}
    return {
        name: tuple(pid for pid in pids if (one := owners[name]) is None or pid != one.pid)
        for name, pids in users.items()
    }


def _mapped_segments(pid: int) -> set[str]:
    """Names of the segments that a process has mapped."""
    try:
        lines = Path(f"/proc/{pid}/maps").read_text(encoding="utf-8", errors="replace").splitlines()
    except OSError:  # the process has ended, or belongs to another user
        return set()
    prefix = f"{SHARED}/escape-"
    return {line[line.index(prefix) + len(str(SHARED)) + 1 :] for line in lines if prefix in line}
