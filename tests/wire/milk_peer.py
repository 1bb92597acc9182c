"""milk's own library (ImageStreamIO 2.x), as the peer in tests; as a program, in a separate process.

``python milk_peer.py write NAME PERIOD_S COUNT`` writes ramps at a steady rate, ``echo IN OUT COUNT`` waits
for the image ``IN`` through the library and copies every array to ``OUT``. Both print a line once ready.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import sys
import time
from typing import Any

import numpy as np

from escape_hw.io.interchange.milk import layout

NAME = os.environ.get("ESCAPE_IMAGESTREAMIO_LIBRARY") or ctypes.util.find_library("ImageStreamIO")
#: Where the structure that its functions take points to what; room for all of it.
_MD, _ARRAY, _KEYWORDS, _COUNTS, _WRITTEN, _RING, _IMAGE_BYTES = 120, 128, 144, 208, 224, 240, 512
#: What images are unless said otherwise (``MATH_DATA``), and circular buffers with time stamps.
PLAIN, CIRCULAR = 0x2, 0x20001


class Image:
    """An image of the library's."""

    def __init__(self, library: Any) -> None:
        self.library, self.raw = library, ctypes.create_string_buffer(_IMAGE_BYTES)

    def create(
        self,
        name: str,
        shape: tuple[int, ...],
        dtype: str,
        keywords: int = 3,
        kind: int = PLAIN,
        ring: int = 0,
    ) -> Image:
        sizes = (ctypes.c_uint32 * 3)(*reversed(shape))
        code = {np.dtype(kind): code for code, kind in layout.DTYPES.items()}[np.dtype(dtype)]
        call = self.library.ImageStreamIO_createIm_gpu
        error = call(
            self.raw, name.encode(), ctypes.c_long(len(shape)), sizes, ctypes.c_uint8(code),
            ctypes.c_int8(-1), 1, layout.SEMAPHORES, keywords, ctypes.c_uint64(kind), ctypes.c_uint32(ring),
        )  # fmt: skip
        assert error == 0
        return self

    def open(self, name: str) -> int:
        return int(self.library.ImageStreamIO_openIm(self.raw, name.encode()))

    def _pointer(self, at: int) -> int:
        return ctypes.c_uint64.from_buffer(self.raw, at).value

    @property
    def md(self) -> layout.Metadata:
        return layout.Metadata.from_address(self._pointer(_MD))

    @property
    def array(self) -> np.ndarray:
        return self._array_at(self._pointer(_ARRAY), layout.image_shape(self.md))

    def copied(self, number: int) -> np.ndarray:
        """One of the copies in the ring."""
        at = self._pointer(_RING) + number * self.md.data_bytes
        return self._array_at(at, layout.image_shape(self.md))

    def _array_at(self, at: int, shape: tuple[int, ...]) -> np.ndarray:
        dtype = layout.DTYPES[self.md.datatype]
        memory = (ctypes.c_ubyte * (int(np.prod(shape)) * dtype.itemsize)).from_address(at)
        return np.frombuffer(memory, dtype).reshape(shape)

    def keyword(self, number: int) -> Any:
        """The bytes of a keyword, in place."""
        return (ctypes.c_ubyte * 128).from_address(self._pointer(_KEYWORDS) + 128 * number)

    def slice(self, number: int) -> np.ndarray:
        """A slice of a circular buffer, where the library says it is."""
        at = ctypes.c_void_p()
        assert self.library.ImageStreamIO_readBufferAt(self.raw, ctypes.c_uint(number), ctypes.byref(at)) == 0
        assert at.value is not None
        return self._array_at(at.value, layout.image_shape(self.md)[1:])

    def stamp(self, number: int) -> tuple[int, int, int]:
        """Seconds, nanoseconds and count of a slice."""
        times = (ctypes.c_int64 * 2).from_address(self._pointer(_WRITTEN) + 16 * number)
        return times[0], times[1], ctypes.c_uint64.from_address(self._pointer(_COUNTS) + 8 * number).value

    def update(self, data: np.ndarray) -> None:
        self.md.write = 1
        self.array[...] = data
        self.library.ImageStreamIO_UpdateIm(self.raw)

    def wait(self, semaphore: int, timeout_s: float) -> bool:
        """Wait as milk's processes do."""
        until = time.time() + timeout_s
        moment = (ctypes.c_int64 * 2)(int(until), int(until % 1 * 1e9))
        return int(self.library.ImageStreamIO_semtimedwait(self.raw, semaphore, moment)) == 0

    def destroy(self) -> None:
        assert self.library.ImageStreamIO_destroyIm(self.raw) == 0


def ramp(shape: tuple[int, ...], number: int) -> np.ndarray:
    """A frame whose every pixel tells its number."""
    return (np.arange(int(np.prod(shape))).reshape(shape) + number) % 1024


def write(image: Image, period_s: float, count: int) -> None:
    """Write ramps until so many are written."""
    frames = [ramp(image.array.shape, number).astype(image.array.dtype) for number in range(1024)]
    due = time.monotonic()
    for number in range(1, count + 1):
        due += period_s
        time.sleep(max(0.0, due - time.monotonic()))
        image.update(frames[number % 1024])


def echo(source: Image, target: Image, count: int) -> None:
    """Copy what others write, woken by the library's semaphore."""
    semaphore = source.library.ImageStreamIO_getsemwaitindex(source.raw, 0)
    source.library.ImageStreamIO_semflush(source.raw, ctypes.c_long(semaphore))
    print(f"waiting on {semaphore}", flush=True)
    for _ in range(count):
        assert source.wait(semaphore, 30), "nothing was posted"
        target.update(source.array)


def main(role: str, name: str, *rest: str) -> None:
    library = ctypes.CDLL(NAME)
    image = Image(library)
    assert image.open(name) == 0
    if role == "write":
        print("writing", flush=True)
        write(image, float(rest[0]), int(rest[1]))
    else:
        target = Image(library)
        assert target.open(rest[0]) == 0
        echo(image, target, int(rest[1]))


if __name__ == "__main__":
    main(*sys.argv[1:])
