"""Shared-memory images against milk's own library (ImageStreamIO 2.x), where it is installed.

``ESCAPE_IMAGESTREAMIO_LIBRARY`` names another ``libImageStreamIO.so`` than the loader finds.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import os
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from escape_hw.errors import ProductError
from escape_hw.io.interchange import milk_layout as layout
from escape_hw.io.interchange.milk_stream import MilkStream

NAME = os.environ.get("ESCAPE_IMAGESTREAMIO_LIBRARY") or ctypes.util.find_library("ImageStreamIO")
needs_library = pytest.mark.skipif(
    not NAME, reason="needs ImageStreamIO; ESCAPE_IMAGESTREAMIO_LIBRARY names it"
)
#: Where the structure that its functions take points to the metadata, the data and the file's size.
_MD, _ARRAY, _IMAGE_BYTES = 120, 128, 512
SHAPES = [(6,), (5, 7), (3, 3), (4, 3, 2), (48, 64)]


class Image:
    """An image of the library's."""

    def __init__(self, library: Any) -> None:
        self.library, self.raw = library, ctypes.create_string_buffer(_IMAGE_BYTES)

    def create(self, name: str, shape: tuple[int, ...], dtype: str) -> Image:
        sizes = (ctypes.c_uint32 * 3)(*reversed(shape))
        code = {np.dtype(kind): code for code, kind in layout.DTYPES.items()}[np.dtype(dtype)]
        call = self.library.ImageStreamIO_createIm
        code = call(self.raw, name.encode(), ctypes.c_long(len(shape)), sizes, ctypes.c_uint8(code), 1, 3, 0)
        assert code == 0
        return self

    def open(self, name: str) -> int:
        return int(self.library.ImageStreamIO_openIm(self.raw, name.encode()))

    @property
    def md(self) -> layout.Metadata:
        return layout.Metadata.from_address(ctypes.c_uint64.from_buffer(self.raw, _MD).value)

    @property
    def array(self) -> np.ndarray:
        address = ctypes.c_uint64.from_buffer(self.raw, _ARRAY).value
        memory = (ctypes.c_ubyte * self.md.data_bytes).from_address(address)
        return np.frombuffer(memory, layout.DTYPES[self.md.datatype]).reshape(layout.shape_of(self.md))

    def update(self, data: np.ndarray) -> None:
        self.md.write = 1
        self.array[...] = data
        self.library.ImageStreamIO_UpdateIm(self.raw)


@pytest.fixture
def library(tmp_path: Path) -> Iterator[Any]:
    # The library reads the folder once in its life, so all tests share one.
    folder = _folder()
    yield ctypes.CDLL(NAME)
    for path in folder.glob("*.im.shm"):
        path.unlink()


def _folder() -> Path:
    folder = Path(os.environ.setdefault("MILK_SHM_DIR", f"/dev/shm/escape_test_{os.getpid()}"))
    folder.mkdir(exist_ok=True)
    return folder


@pytest.fixture(scope="module", autouse=True)
def _no_folder_left() -> Iterator[None]:
    before = os.environ.get("MILK_SHM_DIR")
    yield
    if before is None and "MILK_SHM_DIR" in os.environ:
        Path(os.environ.pop("MILK_SHM_DIR")).rmdir()


def samples(shape: tuple[int, ...], dtype: str) -> np.ndarray:
    return np.arange(int(np.prod(shape))).reshape(shape).astype(dtype)


@needs_library
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", ["u1", "u2", "f4", "f8"])
def test_we_read_and_write_what_the_library_made(library: Any, shape: tuple[int, ...], dtype: str) -> None:
    image = Image(library).create("made", shape, dtype)
    stream = MilkStream.open("made")
    try:
        assert stream.shape == shape
        assert stream.dtype == np.dtype(dtype)
        data = samples(shape, dtype)
        image.update(data)
        found = stream.latest()
        np.testing.assert_array_equal(found.data, data)
        assert found.count == 1
        stream.write(data + 1)
        np.testing.assert_array_equal(image.array, data + 1)
        assert image.md.cnt0 == 2
    finally:
        stream.close()


@needs_library
@pytest.mark.parametrize("shape", [(6,), (48, 64)])
def test_the_library_reads_and_writes_what_we_made(library: Any, shape: tuple[int, ...]) -> None:
    stream = MilkStream.create("ours", shape, "f4")
    try:
        image = Image(library)
        assert image.open("ours") == 0
        data = samples(shape, "f4")
        stream.write(data)
        np.testing.assert_array_equal(image.array, data)
        assert image.md.name == b"ours"
        image.update(2 * data)
        np.testing.assert_array_equal(stream.latest().data, 2 * data)
        assert stream.count == 2
    finally:
        stream.close()


@needs_library
def test_each_wakes_the_other(library: Any) -> None:
    image = Image(library).create("wake", (48, 64), "u2")
    stream = MilkStream.open("wake")
    try:
        waiting = stream.after(0, 0.0)
        assert waiting is None
        teller = threading.Timer(0.2, image.update, [np.full((48, 64), 7)])
        teller.start()
        began = time.monotonic()
        found = stream.after(0, 20.0)
        assert found is not None
        assert (found.data == 7).all()
        assert time.monotonic() - began < 10
        # Its own semaphore, not the one that this process waits on.
        index = library.ImageStreamIO_getsemwaitindex(image.raw, 0)
        assert index >= 0
        before = library.ImageStreamIO_semvalue(image.raw, ctypes.c_long(9))
        stream.write(np.zeros((48, 64)))
        assert library.ImageStreamIO_semvalue(image.raw, ctypes.c_long(9)) == min(
            before + 1, layout.SEMAPHORE_MAX
        )
    finally:
        stream.close()


@needs_library
def test_another_version_is_opened_by_neither(library: Any) -> None:
    stream = MilkStream.create("new", (4, 4), "f4", version="1.05")
    try:
        assert Image(library).open("new") != 0
        with pytest.raises(ProductError, match=r"version '1.05'"):
            MilkStream.open("new")
    finally:
        stream.close()
