"""Files that are either whole or not there."""

from __future__ import annotations

import contextlib
import errno
import os
import shutil
import tempfile
from pathlib import Path

from escape_hw.bounded_files import reason_of
from escape_hw.errors import ConfigError, StorageError

#: Free space that must remain after writing a file, in bytes.
MARGIN_BYTES = 1 << 20

_ELSEWHERE = "choose another folder"
_REMEDIES = {
    errno.ENOSPC: "free some space or " + _ELSEWHERE,
    errno.EDQUOT: "your quota is used up; free some space or " + _ELSEWHERE,
    errno.EFBIG: "files of this size are not allowed here; " + _ELSEWHERE,
    errno.EACCES: "you may not write there; " + _ELSEWHERE,
    errno.EPERM: "you may not write there; " + _ELSEWHERE,
    errno.EROFS: "the file system is read-only; " + _ELSEWHERE,
    errno.ENOTDIR: "a part of the path is a file; " + _ELSEWHERE,
    errno.EISDIR: "a folder of that name exists; choose another name",
}


def storage_error(path: Path, error: OSError) -> StorageError:
    """Put an operating-system error into words that name the path and the way out."""
    remedy = _REMEDIES.get(error.errno or 0, "check the disk or " + _ELSEWHERE)
    return StorageError(f"{path}: cannot be written ({error.strerror or error}); {remedy}")


def make_folder(folder: Path) -> None:
    """Create a folder and its parents.

    Raises
    ------
    StorageError
        The folder cannot be created.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise storage_error(folder, error) from error


def check_space(folder: Path, need_bytes: int) -> None:
    """Refuse early when a file of ``need_bytes`` would not fit.

    Raises
    ------
    StorageError
        Less than ``need_bytes`` plus :data:`MARGIN_BYTES` are free.
    """
    try:
        free = shutil.disk_usage(folder).free
    except OSError as error:
        raise storage_error(folder, error) from error
    if free < need_bytes + MARGIN_BYTES:
        raise StorageError(
            f"{folder}: {free / 1e6:.1f} MB free, {(need_bytes + MARGIN_BYTES) / 1e6:.1f} MB needed; "
            "free some space or " + _ELSEWHERE
        )


def check_writable(folder: Path, need_bytes: int = 0) -> None:
    """Check by writing that a folder accepts files, before anything moves.

    Raises
    ------
    StorageError
        It does not.
    """
    check_space(folder, need_bytes)
    try:
        with tempfile.TemporaryFile(dir=folder) as probe:
            probe.write(b"\0" * 4096)
            probe.flush()
            os.fsync(probe.fileno())
    except OSError as error:
        raise storage_error(folder, error) from error


def refuse_existing(*paths: Path | None) -> None:
    """Refuse files that a command would overwrite; called before it does anything.

    Raises
    ------
    ConfigError
        A file, folder or link of that name exists.
    """
    for path in paths:
        if path is not None and os.path.lexists(path):
            raise ConfigError(f"{path}: exists already; choose another name or remove it first")


def check_readable(folder: Path) -> None:
    """Refuse a folder whose files cannot be listed.

    Raises
    ------
    StorageError
        It does not exist, is no folder, or may not be read.
    """
    try:
        with os.scandir(folder):
            return
    except (OSError, ValueError) as error:
        raise StorageError(
            f"{folder}: cannot be read ({reason_of(error)}); choose an existing folder"
        ) from error


def write_atomic(path: Path, content: bytes) -> None:
    """Write a file that appears whole or not at all, and survives a power cut once it has appeared.

    The content goes to a temporary file in the same folder, is forced to the disk and then takes
    the name; an older file of that name stays untouched until then.

    Raises
    ------
    StorageError
        Disk full, no permission, ...; no half file is left.
    """
    make_folder(path.parent)
    check_space(path.parent, len(content))
    try:
        handle, name = tempfile.mkstemp(prefix=f".{path.name}.", suffix=".tmp", dir=path.parent)
    except OSError as error:
        raise storage_error(path, error) from error
    temporary = Path(name)
    try:
        _write_all(handle, content)
        temporary.chmod(0o666 & ~_umask())  # mkstemp creates files that only the owner may read
        temporary.replace(path)
        _sync_folder(path.parent)
    except OSError as error:
        raise storage_error(path, error) from error
    finally:
        with contextlib.suppress(FileNotFoundError):
            temporary.unlink()


def _write_all(handle: int, content: bytes) -> None:
    try:
        view = memoryview(content)
        while view:
            view = view[os.write(handle, view) :]
        os.fsync(handle)
    finally:
        os.close(handle)


def _umask() -> int:
    """The process's mask, read without changing it for other threads where the system allows."""
    with contextlib.suppress(OSError), open("/proc/self/status", encoding="ascii") as status:
        for line in status:
            if line.startswith("Umask:"):
                return int(line.split()[1], 8)
    return 0o022


def _sync_folder(folder: Path) -> None:
    """Force the new name to the disk; not every system can open a folder."""
    with contextlib.suppress(PermissionError, IsADirectoryError):
        handle = os.open(folder, os.O_RDONLY)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
