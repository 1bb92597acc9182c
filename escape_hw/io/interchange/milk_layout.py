"""How ImageStreamIO lays out an image in shared memory, as its public header ``ImageStruct.h`` describes it.

A file ``NAME.im.shm`` holds the metadata, the data, keywords, semaphores and their book-keeping, one after
the other. Since 2.00 (June 2023) semaphores live in the file itself; later releases of 2.x begin every
section at a multiple of eight bytes. Little-endian 64-bit Linux is assumed, as there.
"""

from __future__ import annotations

import ctypes
import math
import os
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

#: Version written into streams that are made here; readers of another version refuse them.
VERSION = "2.00"
SEMAPHORES = 10
#: A semaphore that nobody waits for does not count beyond this.
SEMAPHORE_MAX = 10
SEMAPHORE_BYTES = 32

_FOLDERS = ("/milk/shm", "/tmp")
_SUFFIX = ".im.shm"
_NAME_BYTES = 80
_PROCESS_TRACES, _TRACE_BYTES, _KEYWORD_BYTES, _RING_ENTRY_BYTES = 10, 64, 128, 48
#: Data types by their code.
DTYPES: dict[int, np.dtype[np.generic]] = {
    code: np.dtype(name)
    for code, name in enumerate(
        ("u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8", "c8", "c16", "f2"), 1
    )
}


class _Time(ctypes.Structure):
    _fields_ = (("seconds", ctypes.c_int64), ("nanoseconds", ctypes.c_int64))


class Metadata(ctypes.Structure):
    """The first 384 bytes (``IMAGE_METADATA``)."""

    _fields_ = (
        ("version", ctypes.c_char * 32),
        ("name", ctypes.c_char * _NAME_BYTES),
        ("naxis", ctypes.c_uint8),
        ("size", ctypes.c_uint32 * 3),
        ("nelement", ctypes.c_uint64),
        ("datatype", ctypes.c_uint8),
        ("imagetype", ctypes.c_uint64),
        ("creationtime", _Time),
        ("lastaccesstime", _Time),
        ("atime", _Time),
        ("writetime", _Time),
        ("creator_pid", ctypes.c_int32),
        ("owner_pid", ctypes.c_int32),
        ("shared", ctypes.c_uint8),
        ("inode", ctypes.c_uint64),
        ("location", ctypes.c_int8),
        ("status", ctypes.c_uint8),
        ("flag", ctypes.c_uint64),
        ("logflag", ctypes.c_uint8),
        ("sem", ctypes.c_uint16),
        ("n_traces", ctypes.c_uint16),
        ("cnt0", ctypes.c_uint64),
        ("cnt1", ctypes.c_uint64),
        ("cnt2", ctypes.c_uint64),
        ("write", ctypes.c_uint8),
        ("n_keywords", ctypes.c_uint16),
        ("ring_size", ctypes.c_uint32),
        ("ring_index", ctypes.c_uint32),
        ("ring_cycle", ctypes.c_uint64),
        ("data_bytes", ctypes.c_uint64),
        ("cuda_handle", ctypes.c_char * 64),
    )


HEADER_BYTES = ctypes.sizeof(Metadata)


@dataclass(frozen=True, slots=True)
class Sections:
    """Where the sections of a file begin, in bytes from its start.

    Parameters
    ----------
    semaphores
        The semaphores, ``sem`` times :data:`SEMAPHORE_BYTES`.
    log
        The semaphore for loggers.
    readers, writers
        Numbers of the processes that wait for and post each semaphore, 4 bytes each.
    total
        Size of the file.
    """

    semaphores: int
    log: int
    readers: int
    writers: int
    total: int


def sections(head: Metadata, step: int) -> Sections:
    """Where the sections of a file lie.

    Parameters
    ----------
    head
        Its metadata.
    step
        Sections begin at multiples of this: 8 in later releases, 1 in the first of 2.00.
    """
    n, at, starts = int(head.sem), HEADER_BYTES, []
    slices = int(head.size[2]) if head.naxis == 3 and (step > 1 or head.imagetype & 0xF000F == 0x20001) else 0
    for length in (
        int(head.data_bytes), _KEYWORD_BYTES * int(head.n_keywords), SEMAPHORE_BYTES * n, SEMAPHORE_BYTES,
        4 * n, 4 * n, 4 * n, 4 * n, _TRACE_BYTES * int(head.n_traces), 16 * slices, 16 * slices, 8 * slices,
        _RING_ENTRY_BYTES * int(head.ring_size), int(head.data_bytes) * int(head.ring_size),
    ):  # fmt: skip
        starts.append(at)
        at += math.ceil(length / step) * step
    return Sections(starts[2], starts[3], starts[4], starts[5], at)


def found_sections(head: Metadata, file_bytes: int) -> Sections | None:
    """The sections of a file of that size; ``None`` where it is laid out in no way known here."""
    for step in (8, 1):
        found = sections(head, step)
        if found.total == file_bytes:
            return found
    return None


def fresh_metadata(name: str, shape: tuple[int, ...], dtype: DTypeLike, version: str) -> Metadata:
    """Metadata of a new stream, apart from what only its file can tell.

    Parameters
    ----------
    name
        Name of the stream.
    shape
        Shape of its arrays, one to three axes, rows first (milk counts the fastest axis first).
    dtype
        Type of its elements.
    version
        Version of the layout to claim.

    Raises
    ------
    ValueError
        milk has no such name, shape or type.
    """
    wanted = np.dtype(dtype).newbyteorder("=")
    codes = [code for code, known in DTYPES.items() if known == wanted]
    if not codes:
        raise ValueError(f"milk has no type for {wanted}")
    if not 1 <= len(shape) <= 3 or min(shape) < 1:
        raise ValueError(f"milk has no images of shape {shape}; one to three axes, none of them empty")
    if not name or "/" in name or len(name.encode()) >= _NAME_BYTES:
        raise ValueError(f"{name!r} is no name of a stream: no '/', fewer than {_NAME_BYTES} bytes")
    head = Metadata(name=name.encode(), naxis=len(shape), nelement=math.prod(shape), datatype=codes[0])
    for axis, length in enumerate(reversed(shape)):
        head.size[axis] = length
    head.imagetype = 2  # mathematical data, as the library's own default
    head.shared, head.location, head.status = 1, -1, 1
    head.sem, head.n_traces = SEMAPHORES, _PROCESS_TRACES
    head.data_bytes = math.prod(shape) * wanted.itemsize
    head.creator_pid = os.getpid()
    head.version = version.encode()
    return head


def shape_of(head: Metadata) -> tuple[int, ...]:
    """Shape of the arrays, rows first."""
    return tuple(int(n) for n in reversed(head.size[: head.naxis]))


def problem_of(head: Metadata, file_bytes: int) -> str | None:
    """What keeps a stream from being read here; ``None``: nothing."""
    version = head.version.decode("ascii", "replace")
    if not version.startswith("2."):
        return f"its layout is version {version!r}; 2.x is read here"
    if head.location >= 0:
        return f"its data lie on graphics card {head.location}; copy it to main memory first"
    if head.datatype not in DTYPES or not 1 <= head.naxis <= 3:
        return f"its metadata are damaged (type {head.datatype}, {head.naxis} axes)"
    bytes_ = math.prod(shape_of(head)) * DTYPES[head.datatype].itemsize
    if bytes_ != head.data_bytes or HEADER_BYTES + bytes_ > file_bytes or bytes_ == 0:
        return f"its metadata do not fit its {file_bytes} bytes (was milk compiled with DAO_COMPAT?)"
    return None


def shm_folder() -> Path:
    """Where streams live: ``MILK_SHM_DIR``, else ``/milk/shm``, else ``/tmp``, the first that exists."""
    named = os.environ.get("MILK_SHM_DIR", "")
    places = [Path(place) for place in (named, *_FOLDERS) if place]
    return next((place for place in places if place.is_dir()), places[-1])


def shm_path(name: str) -> Path:
    """The file of a stream."""
    return shm_folder() / f"{name}{_SUFFIX}"
