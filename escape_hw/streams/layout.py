"""How a ring lies in memory.

A page of header, then slots of equal size. All is in the machine's own byte order: a ring never
leaves the machine. Entry ``n`` (counted from 0) lies in slot ``n % slots``. Its writer puts ``n + 1``
in the slot's *began*, the entry, ``n + 1`` in *ended*, and last ``n + 1`` in the header's *written*. A
reader that finds ``n + 1`` in *ended* before it copies and still in *began* afterwards has copied
entry ``n`` and nothing else. This needs stores and loads to be seen in their order, which x86-64
guarantees.
"""

from __future__ import annotations

import struct

import numpy as np

from escape_hw.streams.timing import BINS

#: Slots and payload bytes of a slot, after the segment's identity.
GEOMETRY = struct.Struct("=QQ")
#: Places in the header, in words of eight bytes.
WRITTEN, CLOSED = 16, 24
#: Counts of the intervals between entries, see :mod:`escape_hw.streams.timing`.
INTERVALS = 32
HEADER_BYTES = 8192

#: Places in a slot, in words.
BEGAN, ENDED = 0, 1
#: Index, exposed, arrived, bytes of the payload; dtype's number, dimensions, bytes of meta; shape.
ENTRY = struct.Struct("@qqqqIIII4q")
ENTRY_AT = 16
META_AT = ENTRY_AT + ENTRY.size
META_BYTES = 256
SLOT_HEADER_BYTES = 384

#: A dtype's number is its place here.
DTYPES = tuple(np.dtype(code) for code in ("?", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"))
MAX_DIMENSIONS = 4

if META_AT + META_BYTES > SLOT_HEADER_BYTES or 8 * (INTERVALS + BINS) > HEADER_BYTES:
    raise AssertionError("the layout of a ring does not fit its headers")


def slot_bytes(capacity: int) -> int:
    """Bytes of a slot, a whole number of cache lines."""
    return SLOT_HEADER_BYTES + -(-capacity // 64) * 64
