"""Memory layout of a ring.

A header is followed by slots of equal size, in native byte order. Entry ``n`` (counted from 0) is in slot
``n % slots``. The writer stores ``n + 1`` in the slot's *began*, then the entry, then ``n + 1`` in *ended*,
and at last ``n + 1`` in the header's *written*. A reader that finds ``n + 1`` in *ended* before the copy and
in *began* after it has copied exactly entry ``n``. This needs stores and loads in program order, which
x86-64 guarantees.
"""

from __future__ import annotations

import struct

import numpy as np

from escape_hw.streams.timing import BINS

#: Slots and payload bytes of a slot, after the segment's identity.
GEOMETRY = struct.Struct("=QQ")
#: Offsets in the header, in words of eight bytes.
WRITTEN, CLOSED = 16, 24
#: Histogram of the intervals between entries, see :mod:`escape_hw.streams.timing`.
INTERVALS = 32
HEADER_BYTES = 8192

#: Offsets in a slot, in words.
BEGAN, ENDED = 0, 1
#: Index, exposed, arrived, bytes of the payload; dtype code, dimensions, bytes of metadata, 0; shape.
ENTRY = struct.Struct("@qqqqIIII4q")
ENTRY_AT = 16
META_AT = ENTRY_AT + ENTRY.size
META_BYTES = 256
SLOT_HEADER_BYTES = 384

#: The code of a dtype is its index here.
DTYPES = tuple(np.dtype(code) for code in ("?", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"))
MAX_DIMENSIONS = 4

if META_AT + META_BYTES > SLOT_HEADER_BYTES or 8 * (INTERVALS + BINS) > HEADER_BYTES:
    raise AssertionError("the layout of a ring does not fit its headers")


def slot_bytes(capacity: int) -> int:
    """Bytes of a slot, a multiple of the cache line."""
    return SLOT_HEADER_BYTES + -(-capacity // 64) * 64
