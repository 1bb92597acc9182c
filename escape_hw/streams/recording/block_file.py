"""Files of recorded streams, written in blocks.

A file is a sequence of blocks. A block has entries of one shape: a NumPy array of :data:`HEADER` fields and
one of the data, both in NumPy's file format. A truncated file is readable up to its last complete block.
"""

from __future__ import annotations

import io
import os
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.representation import short_repr
from escape_hw.errors import ProductError

#: Fields of each entry, before the data of a block.
HEADER = np.dtype([("index", "i8"), ("exposed_ns", "i8"), ("arrived_ns", "i8")])
SUFFIX = ".blocks"


def write_block(file: IO[bytes], head: NDArray[Any], data: NDArray[Any]) -> int:
    """Append a block to an unbuffered file and return its size in bytes; a partial block is removed.

    Raises
    ------
    OSError
        The disk is full or not available.
    """
    at = file.tell()
    try:
        for array in (head, data):
            contiguous = np.ascontiguousarray(array)
            front = io.BytesIO()
            np.lib.format.write_array_header_1_0(front, np.lib.format.header_data_from_array_1_0(contiguous))
            _write_all(file, front.getvalue())
            _write_all(file, contiguous.reshape(-1).view(np.uint8).data)
    except OSError:
        file.seek(at)
        file.truncate(at)
        raise
    return file.tell() - at


def _write_all(file: IO[bytes], content: bytes | memoryview) -> None:
    left = memoryview(content)
    while left:
        left = left[file.write(left) :]


@dataclass(frozen=True, slots=True, eq=False)
class Recording:
    """A recorded stream: ``index``, ``exposed_ns`` and ``arrived_ns`` ``(n,)``, and ``data`` ``(n, ...)``.

    ``complete`` is false when the file ends within a block, which is not read.
    """

    index: NDArray[np.int64]
    exposed_ns: NDArray[np.int64]
    arrived_ns: NDArray[np.int64]
    data: NDArray[Any]
    complete: bool
    __repr__ = short_repr


def read_recording(path: Path) -> list[Recording]:
    """Read a recorded stream, one part per sequence of entries of one shape.

    Parameters
    ----------
    path
        ``NAME.blocks``.

    Raises
    ------
    ProductError
        The file does not exist or is not a recording.
    """
    blocks: list[tuple[NDArray[Any], NDArray[Any]]] = []
    complete = True
    try:
        with open(path, "rb") as file:
            size = os.fstat(file.fileno()).st_size
            while file.tell() < size:
                try:
                    head = np.lib.format.read_array(file, allow_pickle=False)
                    data = np.lib.format.read_array(file, allow_pickle=False)
                except (ValueError, EOFError) as error:
                    if not blocks:
                        raise ProductError(
                            f"{path}: contains no complete block of a recording ({error})"
                        ) from error
                    complete = False
                    break
                if head.dtype != HEADER or len(head) != len(data):
                    raise ProductError(f"{path}: not a recording of ESCAPE, or damaged at byte {file.tell()}")
                blocks.append((head, data))
    except OSError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
    return [_concatenate(part, complete) for part in _group_by_shape(blocks)]


def count_entries(path: Path) -> int:
    """Number of entries in the complete blocks of a recorded stream; 0 if it cannot be read."""
    try:
        return sum(n for _, n in _scan_blocks(path))
    except (OSError, ProductError):
        return 0


def read_newest(path: Path, count: int) -> Recording | None:
    """The newest entries of a recorded stream, also of one that is being written; ``None`` if there are none.

    At most ``count`` entries, of one shape. Other blocks are skipped, not read.

    Raises
    ------
    ProductError
        The file does not exist or is not a recording.
    """
    read = []
    try:
        blocks = _scan_blocks(path)
        first, entries = len(blocks), 0
        while first and entries < count:
            first -= 1
            entries += blocks[first][1]
        with open(path, "rb") as file:
            for offset, _ in blocks[first:]:
                file.seek(offset)
                head = np.lib.format.read_array(file, allow_pickle=False)
                read.append((head, np.lib.format.read_array(file, allow_pickle=False)))
    except (OSError, ValueError) as error:
        raise ProductError(f"{path}: cannot be read ({error})") from error
    if not read:
        return None
    newest = _concatenate(_group_by_shape(read)[-1], complete=True)
    part = slice(-count, None)
    return Recording(
        newest.index[part], newest.exposed_ns[part], newest.arrived_ns[part], newest.data[part], True
    )


def _scan_blocks(path: Path) -> list[tuple[int, int]]:
    """Offset and number of entries of every complete block (OSError; ProductError: no recording)."""
    found: list[tuple[int, int]] = []
    with open(path, "rb") as file:
        size = os.fstat(file.fileno()).st_size
        while (offset := file.tell()) < size:
            try:
                head, head_type = _skip_array(file)
                data, _ = _skip_array(file)
            except ValueError as error:
                # A block that is being written ends with the file.
                if not found and file.tell() < size:
                    raise ProductError(f"{path}: not a recording of ESCAPE ({error})") from error
                break
            if head_type != HEADER or len(head) != 1 or head != data[:1]:
                raise ProductError(f"{path}: not a recording of ESCAPE, or damaged at byte {offset}")
            if file.tell() > size:
                break
            found.append((offset, head[0]))
    return found


def _skip_array(file: IO[bytes]) -> tuple[tuple[int, ...], np.dtype[Any]]:
    """Shape and type of the array at the file's position, which moves to its end (ValueError: no array)."""
    np.lib.format.read_magic(file)
    shape, _, dtype = np.lib.format.read_array_header_1_0(file)
    file.seek(dtype.itemsize * int(np.prod(shape)), os.SEEK_CUR)
    return shape, dtype


def _group_by_shape(
    blocks: list[tuple[NDArray[Any], NDArray[Any]]],
) -> list[list[tuple[NDArray[Any], NDArray[Any]]]]:
    """Group consecutive blocks with entries of one shape."""
    parts: list[list[tuple[NDArray[Any], NDArray[Any]]]] = []
    for head, data in blocks:
        last = parts[-1][-1][1] if parts else None
        if last is not None and last.shape[1:] == data.shape[1:] and last.dtype == data.dtype:
            parts[-1].append((head, data))
        else:
            parts.append([(head, data)])
    return parts


def _concatenate(part: list[tuple[NDArray[Any], NDArray[Any]]], complete: bool) -> Recording:
    head = np.concatenate([head for head, _ in part])
    data = np.concatenate([data for _, data in part])
    return Recording(head["index"], head["exposed_ns"], head["arrived_ns"], data, complete)
