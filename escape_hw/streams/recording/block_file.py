"""Files of recorded streams: written in blocks, read back whole.

A stream's file is a sequence of blocks, each a number of entries of one shape: a NumPy array of
:data:`HEADER` fields and one of the data, both in NumPy's own file format, one after the other. A file
that was cut off is legible up to its last whole block.
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

#: What stands before the data of a block, one for each entry.
HEADER = np.dtype([("index", "i8"), ("exposed_ns", "i8"), ("arrived_ns", "i8")])
SUFFIX = ".blocks"


def write_block(file: IO[bytes], head: NDArray[Any], data: NDArray[Any]) -> int:
    """Append a block to an unbuffered file; half a block is taken back. Returns its bytes.

    Raises
    ------
    OSError
        The disk is full, or gone.
    """
    at = file.tell()
    try:
        for array in (head, data):
            complete = np.ascontiguousarray(array)
            front = io.BytesIO()
            np.lib.format.write_array_header_1_0(front, np.lib.format.header_data_from_array_1_0(complete))
            _write_all(file, front.getvalue())
            _write_all(file, complete.reshape(-1).view(np.uint8).data)
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
    """A stream read back: ``index``, ``exposed_ns`` and ``arrived_ns`` ``(n,)``, and ``data`` ``(n, ...)``.

    ``complete`` is false when the file ends in the middle of a block, which is left out.
    """

    index: NDArray[np.int64]
    exposed_ns: NDArray[np.int64]
    arrived_ns: NDArray[np.int64]
    data: NDArray[Any]
    complete: bool
    __repr__ = short_repr


def read_recording(path: Path) -> list[Recording]:
    """A recorded stream, one part for each stretch of entries of one shape.

    Parameters
    ----------
    path
        ``NAME.blocks``.

    Raises
    ------
    ProductError
        There is no such file, or it is none of a recorder.
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
                            f"{path}: no whole block of a recording in it ({error})"
                        ) from error
                    complete = False
                    break
                if head.dtype != HEADER or len(head) != len(data):
                    raise ProductError(f"{path}: no recording of ESCAPE, or damaged at byte {file.tell()}")
                blocks.append((head, data))
    except OSError as error:
        raise ProductError(f"{path}: cannot be read ({error.strerror or error})") from error
    return [_concatenate(part, complete) for part in _group_by_shape(blocks)]


def _group_by_shape(
    blocks: list[tuple[NDArray[Any], NDArray[Any]]],
) -> list[list[tuple[NDArray[Any], NDArray[Any]]]]:
    """Blocks that follow each other with entries of one shape, together."""
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
