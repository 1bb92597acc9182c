"""Shared-memory images against milk's own library (ImageStreamIO 2.x), where it is installed.

``ESCAPE_IMAGESTREAMIO_LIBRARY`` names another ``libImageStreamIO.so`` than the loader finds.
"""

from __future__ import annotations

import ctypes
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import milk_peer
import numpy as np
import pytest
from milk_peer import CIRCULAR, Image, ramp
from streams import SHAPE, camera_config, mirror_config

from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext, device_factory
from escape_hw.errors import ProductError
from escape_hw.io.interchange.milk import layout
from escape_hw.io.interchange.milk.stream import MilkStream

needs_library = pytest.mark.skipif(
    not milk_peer.NAME,
    reason="needs ImageStreamIO, no package of Debian or PyPI; ESCAPE_IMAGESTREAMIO_LIBRARY names it",
)
SHAPES = [(6,), (5, 7), (3, 3), (4, 3, 2), (48, 64)]
DTYPES = [dtype.str for dtype in layout.DTYPES.values()]


@pytest.fixture(scope="module")
def folder() -> Iterator[Path]:
    """A folder of these tests, whatever MILK_SHM_DIR says: that is where the images of a site are."""
    with (
        tempfile.TemporaryDirectory(prefix="escape_test_", dir="/dev/shm") as path,
        pytest.MonkeyPatch.context() as patch,
    ):
        patch.setenv("MILK_SHM_DIR", path)
        yield Path(path)


@pytest.fixture
def library(folder: Path) -> Iterator[Any]:
    # The library reads the folder once in its life, so all tests share one; and it changes the umask.
    umask = os.umask(0o022)
    yield ctypes.CDLL(milk_peer.NAME)
    os.umask(umask)
    for path in folder.glob("*.im.shm"):
        path.unlink()


@pytest.fixture
def version(library: Any) -> str:
    """Version of the library; skips where it opens only images of its own special make."""
    probe = Image(library).create("probe", (8,), "u1")
    found = layout.detect_sections(probe.md, layout.shm_path("probe").stat().st_size)
    assert found is not None
    if found.data != layout.HEADER_BYTES:
        pytest.skip("this library was compiled with DAO_COMPAT, and opens only images of its like")
    text: str = probe.md.version.decode()
    probe.destroy()
    return text


@contextmanager
def another_process(*command: object) -> Iterator[str]:
    """The library in a process of its own; yields what it said once it was ready."""
    program = [sys.executable, milk_peer.__file__, *map(str, command)]
    folders = os.pathsep.join([str(Path(layout.__file__).parents[3]), os.environ.get("PYTHONPATH", "")])
    environment = os.environ | {"PYTHONPATH": folders}
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True, env=environment) as process:
        assert process.stdout is not None
        try:
            yield process.stdout.readline().strip()
            assert process.wait(60) == 0
        finally:
            process.kill()


def samples(shape: tuple[int, ...], dtype: str) -> np.ndarray:
    return np.arange(int(np.prod(shape))).reshape(shape).astype(dtype)


@needs_library
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", DTYPES)
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
        stream.write(data + data.dtype.type(1))
        np.testing.assert_array_equal(image.array, data + data.dtype.type(1))
        assert image.md.cnt0 == 2
        assert image.md.write == 0
        assert layout.detect_sections(image.md, layout.shm_path("made").stat().st_size) is not None
    finally:
        stream.close()
        image.destroy()


@needs_library
@pytest.mark.parametrize("shape", SHAPES)
@pytest.mark.parametrize("dtype", DTYPES)
def test_the_library_reads_and_writes_what_we_made(
    library: Any, version: str, shape: tuple[int, ...], dtype: str
) -> None:
    data = samples(shape, dtype)
    _skip_where_the_library_packs(library, data.nbytes)
    stream = MilkStream.create("ours", shape, dtype, version=version)
    try:
        image = Image(library)
        assert image.open("ours") == 0
        stream.write(data)
        np.testing.assert_array_equal(image.array, data)
        assert image.md.name == b"ours"
        assert library.ImageStreamIO_check_image_inode(image.raw) == 0
        image.update(data + data.dtype.type(1))
        np.testing.assert_array_equal(stream.latest().data, data + data.dtype.type(1))
        assert stream.count == 2
    finally:
        stream.close()


def _skip_where_the_library_packs(library: Any, n_bytes: int) -> None:
    """Its first releases begin sections anywhere; ours then open only if they are aligned by themselves."""
    Image(library).create("packed", (3,), "u1", keywords=0)
    if layout.shm_path("packed").stat().st_size % 8 and n_bytes % 8:
        pytest.skip("this library lays out data of a length like this in a way of its own")


@needs_library
@pytest.mark.parametrize("shape", SHAPES)
def test_an_image_of_ours_is_one_of_the_librarys_byte_for_byte(
    library: Any, version: str, shape: tuple[int, ...]
) -> None:
    _skip_where_the_library_packs(library, 4 * int(np.prod(shape)))
    path = layout.shm_path("same")
    Image(library).create("same", shape, "f4", keywords=0)
    theirs, mode = path.read_bytes(), path.stat().st_mode
    MilkStream.create("same", shape, "f4", version=version).close()
    ours = path.read_bytes()
    assert path.stat().st_mode == mode
    heads = [layout.Metadata.from_buffer_copy(one) for one in (theirs, ours)]
    for head in heads:
        assert head.creationtime.seconds == pytest.approx(time.clock_gettime(time.CLOCK_TAI), abs=60)
        # Of the moment, and of the file.
        for field in ("creationtime", "lastaccesstime"):
            setattr(head, field, layout.Metadata().atime)
        head.inode = 0
    assert bytes(heads[0]) == bytes(heads[1])
    log = layout.compute_sections(heads[0], 8).log
    for begin, end in ((layout.HEADER_BYTES, log), (log + layout.SEMAPHORE_BYTES, len(theirs))):
        assert theirs[begin:end] == ours[begin:end]
    # The loggers' semaphore: the library leaves it as it finds it, we make it one between processes.
    assert not any(theirs[log:][: layout.SEMAPHORE_BYTES])


@needs_library
@pytest.mark.parametrize("keywords", [0, 1, 7])
@pytest.mark.parametrize("ring", [0, 3])
def test_keywords_stay_and_the_ring_gets_our_arrays(library: Any, keywords: int, ring: int) -> None:
    image = Image(library).create("kept", (5, 7), "u2", keywords, ring=ring)
    for number in range(keywords):
        image.keyword(number)[:] = bytes([number + 1] * 128)
    stream = MilkStream.open("kept")
    try:
        index, cycle = 0, 0
        for number in range(1, 6):
            data = np.full((5, 7), number, np.uint16)
            if number % 2:
                stream.write(data)
            else:
                image.update(data)
            assert image.md.cnt0 == stream.latest().count == number
            if ring:
                index, cycle = (index + 1) % ring, cycle + (index + 1) // ring
                assert (image.md.ring_index, image.md.ring_cycle) == (index, cycle)
                np.testing.assert_array_equal(image.copied(index), data)
        for number in range(keywords):
            assert bytes(image.keyword(number)) == bytes([number + 1] * 128)
    finally:
        stream.close()


@needs_library
@pytest.mark.parametrize("n", [1, 3])
def test_a_circular_buffer_is_a_stream_of_its_slices(library: Any, n: int) -> None:
    image = Image(library).create("circle", (n, 5, 7), "f4", kind=CIRCULAR)
    stream = MilkStream.open("circle")
    try:
        assert stream.shape == (5, 7)
        for number in range(1, 2 * n + 2):
            data = np.full((5, 7), number, np.float32)
            place = (image.md.cnt1 + 1) % n
            if number % 2:
                stream.write(data)
                assert image.md.cnt1 == place
                np.testing.assert_array_equal(image.slice(place), data)
                written = image.md.writetime
                assert image.stamp(place) == (written.seconds, written.nanoseconds, number)
            else:
                image.md.write = 1
                image.slice(place)[...] = data
                image.md.cnt1 = place
                library.ImageStreamIO_UpdateIm(image.raw)
            newest = stream.latest()
            assert newest.count == number
            np.testing.assert_array_equal(newest.data, data)
    finally:
        stream.close()


@needs_library
def test_times_are_the_librarys(library: Any) -> None:
    image = Image(library).create("times", (3, 3), "f4")
    stream = MilkStream.open("times")
    try:
        image.update(np.zeros((3, 3)))
        assert stream.latest().written_ns == pytest.approx(time.time_ns(), abs=60e9)
        before = image.md.writetime.seconds + 1e-9 * image.md.writetime.nanoseconds
        stream.write(np.zeros((3, 3)))
        assert 0 <= image.md.writetime.seconds + 1e-9 * image.md.writetime.nanoseconds - before < 60
    finally:
        stream.close()


@needs_library
def test_each_wakes_the_other(library: Any) -> None:
    n = 20
    image = Image(library).create("wake", (48, 64), "u2")
    Image(library).create("answer", (48, 64), "u2")
    ours, answers = MilkStream.open("wake"), MilkStream.open("answer")
    try:
        # A semaphore of ours is ours to the library, too: one with this process's number is found again.
        assert answers.read_after(0, 0.01) is None
        assert ours.read_after(0, 0.01) is None
        assert library.ImageStreamIO_getsemwaitindex(image.raw, 5) == 0
        with another_process("echo", "wake", "answer", n) as said:
            assert said == "waiting on 1", "ours is taken"
            for number in range(1, n + 1):
                ours.write(np.full((48, 64), number))
                found = answers.read_after(number - 1, 30.0)
                assert found is not None
                assert found.count == number
                assert (found.data == number).all()
        ours.close()
        assert library.ImageStreamIO_getsemwaitindex(image.raw, 5) == 5, "it was given back"
    finally:
        ours.close()
        answers.close()


@needs_library
def test_semaphores_stop_counting_where_the_librarys_do(library: Any) -> None:
    image = Image(library).create("many", (3, 3), "f4")
    stream = MilkStream.open("many")
    try:
        for number in range(1, 15):
            stream.write(np.zeros((3, 3)))
            for semaphore in range(layout.SEMAPHORES):
                value = library.ImageStreamIO_semvalue(image.raw, ctypes.c_long(semaphore))
                assert value == min(number, layout.SEMAPHORE_MAX)
    finally:
        stream.close()


@needs_library
def test_another_version_is_opened_by_neither(library: Any, version: str) -> None:
    stream = MilkStream.create("new", (4, 4), "f4", version="1.05")
    try:
        assert Image(library).open("new") != 0
        with pytest.raises(ProductError, match=r"version '1.05'"):
            MilkStream.open("new")
    finally:
        stream.close()


@needs_library
def test_a_camera_follows_what_the_library_writes_at_500_hz(library: Any) -> None:
    Image(library).create("camera", SHAPE, "u2")
    config = camera_config(load_system("razor-shwfs"), "camera")
    camera: Any = device_factory("milk-camera")(config.devices.wfs, DeviceContext("wfs", config))
    with another_process("write", "camera", 0.002, 2000) as said:
        assert said == "writing"
        with camera:
            assert camera.settings.frame_rate_hz == pytest.approx(500, rel=0.3)
            region = camera.settings.region
            frames = [camera.next_frame(5.0) for _ in range(500)]
            lost = camera.status().lost
        for frame in frames:
            part = ramp(SHAPE, frame.index)[region.y :, region.x :][: region.height, : region.width]
            np.testing.assert_array_equal(frame.data, part)
        assert frames[-1].index - frames[0].index + 1 - len(frames) == lost
        assert (np.diff([frame.exposed_ns for frame in frames]) > 0).all()


@needs_library
def test_a_mirror_writes_what_the_library_waits_for(library: Any) -> None:
    n = 50
    image = Image(library).create("dm", (11, 11), "f4")
    Image(library).create("seen", (11, 11), "f4")
    config = mirror_config(load_system("razor-shwfs"), "dm", scale=2.0)
    mirror: Any = device_factory("milk-mirror")(config.devices.dm, DeviceContext("dm", config))
    there = config.devices.dm.actuator_map()
    seen = MilkStream.open("seen")
    generator = np.random.default_rng(4)
    try:
        with mirror:
            with another_process("echo", "dm", "seen", n) as said:
                assert said == "waiting on 0"
                for number in range(n):
                    command = generator.uniform(-0.2, 0.2, int(there.sum()))
                    mirror.send(command)
                    found = seen.read_after(number, 30.0)
                    assert found is not None
                    np.testing.assert_allclose(found.data[there], 2 * command, rtol=1e-6)
                    assert not found.data[~there].any()
            assert image.array.any()
        assert not image.array.any(), "closing must leave the mirror flat"
    finally:
        seen.close()
