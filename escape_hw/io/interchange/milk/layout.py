"""How ImageStreamIO lays out an image in shared memory, as its public header ``ImageStruct.h`` describes it.

A file ``NAME.im.shm`` holds the metadata, the data, keywords, semaphores and their book-keeping, one after
the other. Since 2.00 (June 2023) semaphores live in the file itself; later releases of 2.x begin every
section at a multiple of eight bytes, and ``DAO_COMPAT`` lengthens the metadata. Little-endian 64-bit Linux is
assumed, as there.
"""

from __future__ import annotations

import ctypes
import math
import os
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import DTypeLike

#: Version written into streams that are made here; readers of another version refuse them.
VERSION = "2.00"
_VERSIONS = r"2\.\d\d"
SEMAPHORES = 10
#: Maximum count of a semaphore without a waiting reader.
SEMAPHORE_MAX = 10
SEMAPHORE_BYTES = 32

_FOLDERS = ("/milk/shm", "/tmp")
_SUFFIX = ".im.shm"
_NAME_BYTES = 80
_PROCESS_TRACES, _KEYWORD_BYTES, _RING_ENTRY_BYTES = 10, 128, 48
#: A record of what triggered a writer, and the offset of the semaphore's number in it (-1: none).
TRACE_BYTES, TRACE_SEMAPHORE = 64, 48
#: Time stamp and counter of one slice of a circular buffer.
STAMP_BYTES, COUNT_BYTES = 16, 8
#: Bits of ``imagetype``: slices are consecutive in time and have their own time stamps.
_CIRCULAR, _CIRCULAR_MASK, _STAMPED, _STAMPED_MASK = 0x1, 0xF, 0x20001, 0xF000F
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
    """The first 384 bytes (``IMAGE_METADATA``), which are the same in all of 2.x."""

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
#: What ``DAO_COMPAT`` adds: four numbers and a list of 512 about writes in parts.
_DAO_BYTES = 4 * 4 + 512 * 8


@dataclass(frozen=True, slots=True)
class Sections:
    """Where the sections of a file begin, in bytes from its start.

    Parameters
    ----------
    data
        The array.
    semaphores
        The semaphores, ``sem`` times :data:`SEMAPHORE_BYTES`.
    log
        The semaphore for loggers.
    readers, writers
        Numbers of the processes that wait for and post each semaphore, 4 bytes each.
    traces
        What triggered the writers, ``n_traces`` times :data:`TRACE_BYTES`.
    acquired, written, counts
        Time stamps and counters of the slices of a circular buffer.
    ring
        Copies of the newest arrays, ``ring_size`` of them.
    total
        Size of the file.
    """

    data: int
    semaphores: int
    log: int
    readers: int
    writers: int
    traces: int
    acquired: int
    written: int
    counts: int
    ring: int
    total: int


def compute_sections(head: Metadata, step: int, header_bytes: int = HEADER_BYTES) -> Sections:
    """Where the sections of a file with this header lie.

    They begin at multiples of ``step``: 8 in later releases, 1 in the first of 2.00.
    """
    n, at, starts = int(head.sem), header_bytes, []
    stamped = int(head.size[2]) if head.imagetype & _STAMPED_MASK == _STAMPED else 0
    for length in (
        int(head.data_bytes), _KEYWORD_BYTES * int(head.n_keywords), SEMAPHORE_BYTES * n, SEMAPHORE_BYTES,
        4 * n, 4 * n, 4 * n, 4 * n, TRACE_BYTES * int(head.n_traces), STAMP_BYTES * stamped,
        STAMP_BYTES * stamped, COUNT_BYTES * stamped, _RING_ENTRY_BYTES * int(head.ring_size),
        int(head.data_bytes) * int(head.ring_size),
    ):  # fmt: skip
        starts.append(at)
        at += math.ceil(length / step) * step
    data, _, semaphores, log, readers, writers, _, _, traces, acquired, written, counts, _, ring = starts
    return Sections(data, semaphores, log, readers, writers, traces, acquired, written, counts, ring, at)


def detect_sections(head: Metadata, file_bytes: int) -> Sections | None:
    """The sections of a file of that size; ``None`` where it is laid out in no way known here."""
    for header_bytes in (HEADER_BYTES, HEADER_BYTES + _DAO_BYTES):
        for step in (8, 1):
            found = compute_sections(head, step, header_bytes)
            if found.total == file_bytes:
                return found
    return None


def build_metadata(name: str, shape: tuple[int, ...], dtype: DTypeLike, version: str) -> Metadata:
    """Metadata of a new stream, without the parts that depend on its file.

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
        milk has no such name, shape, type or version.
    """
    wanted = np.dtype(dtype).newbyteorder("=")
    codes = [code for code, known in DTYPES.items() if known == wanted]
    if not codes:
        raise ValueError(f"milk has no type for {wanted}")
    if not 1 <= len(shape) <= 3 or min(shape) < 1:
        raise ValueError(f"milk has no images of shape {shape}; one to three axes, none of them empty")
    if not name or "/" in name or len(name.encode()) >= _NAME_BYTES:
        raise ValueError(f"{name!r} is not a valid stream name: no '/', fewer than {_NAME_BYTES} bytes")
    if not re.fullmatch(_VERSIONS, version):
        raise ValueError(f"layout {version!r}: versions 2.00 to 2.99 can be written, such as {VERSION}")
    head = Metadata(name=name.encode(), naxis=len(shape), nelement=math.prod(shape), datatype=codes[0])
    for axis, length in enumerate(reversed(shape)):
        head.size[axis] = length
    head.imagetype = 2  # mathematical data, as the library's own default
    head.shared, head.location = 1, -1
    head.sem, head.n_traces = SEMAPHORES, _PROCESS_TRACES
    head.data_bytes = math.prod(shape) * wanted.itemsize
    head.creator_pid = os.getpid()
    head.version = version.encode()
    return head


def image_shape(head: Metadata) -> tuple[int, ...]:
    """Shape of the whole image, rows first."""
    return tuple(int(n) for n in reversed(head.size[: head.naxis]))


def is_circular(head: Metadata) -> bool:
    """Whether the slices along the first of three axes were written one after the other."""
    return bool(head.naxis == 3 and head.imagetype & _CIRCULAR_MASK == _CIRCULAR)


def is_stamped(head: Metadata) -> bool:
    """Whether every slice has time stamps and a counter of its own."""
    return is_circular(head) and head.imagetype & _STAMPED_MASK == _STAMPED


def find_problem(head: Metadata, file_bytes: int) -> str | None:
    """What keeps a stream from being read here; ``None``: nothing."""
    version = head.version.decode("ascii", "replace")
    if not version.startswith("2."):
        return f"its layout is version {version!r}; 2.x is read here"
    if head.location >= 0:
        return f"its data lie on graphics card {head.location}; copy it to main memory first"
    if head.datatype not in DTYPES or not 1 <= head.naxis <= 3:
        return f"its metadata are damaged (type {head.datatype}, {head.naxis} axes)"
    bytes_ = math.prod(image_shape(head)) * DTYPES[head.datatype].itemsize
    if bytes_ != head.data_bytes or bytes_ == 0 or detect_sections(head, file_bytes) is None:
        return (
            f"its {file_bytes} bytes fit no layout that is known here (was milk compiled with "
            "IMAGESTRUCT_WRITEHISTORY?)"
        )
    return None


def shm_folder() -> Path:
    """Where streams live: ``MILK_SHM_DIR``, else ``/milk/shm``, else ``/tmp``, the first that exists."""
    named = os.environ.get("MILK_SHM_DIR", "")
    places = [Path(place) for place in (named, *_FOLDERS) if place]
    return next((place for place in places if place.is_dir()), places[-1])


def shm_path(name: str) -> Path:
    """The file of a stream."""
    return shm_folder() / f"{name}{_SUFFIX}"
