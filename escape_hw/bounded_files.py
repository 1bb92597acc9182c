"""Reading of files of limited size: a file is never read as a whole before its size is known."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path

#: Largest text of a configuration, bytes; the bundled ones have a few thousand.
MAX_TEXT_BYTES = 1_000_000
#: Largest calibration file of another program, bytes.
MAX_ARRAY_BYTES = 1 << 30


def max_product_bytes() -> int:
    """Largest product that is read into memory: half of the computer's memory."""
    return os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") // 2


def read_bounded(path: Path, limit: int) -> bytes:
    """The content of a file.

    Raises
    ------
    OSError
        It cannot be read, or has more than ``limit`` bytes (``EFBIG``); nothing beyond is read.
    """
    try:
        file = path.open("rb")
    except ValueError as error:
        # A null byte, or a character that no path has.
        raise OSError(errno.EINVAL, str(error), str(path)) from error
    with file:
        found = os.fstat(file.fileno())
        if stat.S_ISREG(found.st_mode) and found.st_size > limit:
            raise _too_large(path, limit)
        content = file.read(limit + 1)
    if len(content) > limit:
        raise _too_large(path, limit)
    return content


def reason_of(error: BaseException) -> str:
    """The reason of an error for a message that names the file itself."""
    return str(getattr(error, "strerror", None) or error)


def shorten_path(path: str) -> str:
    """A path for a message; the middle of a very long one is left out."""
    return path if len(path) <= 300 else f"{path[:150]}...{path[-150:]}"


def _too_large(path: Path, limit: int) -> OSError:
    return OSError(errno.EFBIG, f"larger than {limit / 1e6:.0f} MB, the most that is read", str(path))
