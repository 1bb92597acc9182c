"""Rings of arrays in shared memory, used from one process."""

from __future__ import annotations

import math
import os
import types
from collections.abc import Iterator

import numpy as np
import pytest

from escape_hw.errors import StorageError
from escape_hw.streams import ring as ring_reader
from escape_hw.streams import segments
from escape_hw.streams.ring import RingReader, RingWriter
from escape_hw.streams.segments import StreamUnavailable, segment_name


@pytest.fixture
def writer() -> Iterator[RingWriter]:
    with RingWriter(segment_name("test.ring", "frames"), 4096) as made:
        yield made
    assert segments.segments(pid=os.getpid()) == ()


def test_an_entry_comes_out_as_it_went_in(writer: RingWriter) -> None:
    with RingReader(writer.name) as reader:
        assert reader.latest() is None
        data = np.arange(12, dtype=np.uint16).reshape(3, 4)
        writer.write(data, 7, 5, 6, b'{"stage": "DO-CRIME"}')
        sample = reader.latest()
        assert sample is not None
        assert (sample.index, sample.exposed_ns, sample.arrived_ns) == (7, 5, 6)
        assert sample.meta == {"stage": "DO-CRIME"}
        np.testing.assert_array_equal(sample.data, data)
        data[:] = 0
        writer.write(data, 8)
        assert sample.data.max() == 11
        newer = reader.latest(after=7)
        assert newer is not None
        assert newer.index == 8
        assert newer.arrived_ns > 0
        assert newer.meta == {}
        assert reader.latest(after=8) is None


@pytest.mark.parametrize("dtype", ["?", "u1", "i1", "u2", "i2", "u4", "i4", "u8", "i8", "f4", "f8"])
@pytest.mark.parametrize("shape", [(), (5,), (3, 4), (2, 3, 4), (1, 2, 3, 4), (0, 3)])
def test_shape_and_type_may_change(writer: RingWriter, dtype: str, shape: tuple[int, ...]) -> None:
    with RingReader(writer.name) as reader:
        for number in range(20):
            writer.write(np.full(number + 1, 0.5), number)
            data = np.ones(shape, dtype)
            writer.write(data, 1000 + number)
            sample = reader.latest()
            assert sample is not None
            assert (sample.data.dtype, sample.data.shape) == (data.dtype, shape)
            np.testing.assert_array_equal(sample.data, data)


def test_a_strided_array_is_written_whole(writer: RingWriter) -> None:
    data = np.arange(48.0).reshape(6, 8)[::2, ::-3]
    with RingReader(writer.name) as reader:
        writer.write(data, 0)
        sample = reader.latest()
        assert sample is not None
        np.testing.assert_array_equal(sample.data, data)


def test_what_does_not_fit_is_refused_and_the_last_entry_stays(writer: RingWriter) -> None:
    with RingReader(writer.name) as reader:
        writer.write(np.ones(3), 1)
        with pytest.raises(ValueError, match=r"4104 bytes|4096 bytes"):
            writer.write(np.ones(513), 2)
        with pytest.raises(ValueError, match="complex128 cannot be streamed"):
            writer.write(np.ones(3, complex), 2)
        with pytest.raises(ValueError, match="257 bytes of meta"):
            writer.write(np.ones(3), 2, meta=b"x" * 257)
        with pytest.raises(ValueError, match="dimensions"):
            writer.write(np.ones((1, 1, 1, 1, 1)), 2)
        sample = reader.latest()
        assert sample is not None
        assert sample.index == 1


def test_a_recorder_gets_every_entry_in_order_and_knows_what_it_missed(writer: RingWriter) -> None:
    with RingReader(writer.name) as reader:
        assert reader.next() is None
        for number in range(5):
            writer.write(np.array([number]), number)
        got = [sample.index for sample in iter(reader.next, None)]
        assert got == [0, 1, 2, 3, 4]
        assert reader.missed == 0
        for number in range(5, 25):
            writer.write(np.array([number]), number)
        got = [sample.index for sample in iter(reader.next, None)]
        # Eight are kept, and the oldest of them may be overwritten at any moment.
        assert got == list(range(18, 25))
        assert reader.missed == 13
        reader.seek_newest()
        assert reader.next() is None


def test_a_reader_that_is_overtaken_while_it_copies_takes_the_newest(
    writer: RingWriter, monkeypatch: pytest.MonkeyPatch
) -> None:
    laps = [3 * writer.slots, writer.slots, 1]

    def overtaken(shape: tuple[int, ...]) -> int:
        for _ in range(laps.pop(0) if laps else 0):
            writer.write(np.full(100, writer.written), writer.written)
        return math.prod(shape)

    with RingReader(writer.name) as reader:
        writer.write(np.full(100, 0), 0)
        monkeypatch.setattr(ring_reader, "math", types.SimpleNamespace(prod=overtaken))
        sample = reader.latest()
        assert sample is not None
        # The first two copies were overwritten; during the third one slot more was written.
        assert laps == []
        assert sample.index == 4 * writer.slots
        assert (sample.data == sample.index).all()


def test_indices_that_begin_anew_count_as_newer(writer: RingWriter) -> None:
    with RingReader(writer.name) as reader:
        writer.write(np.ones(1), 900)
        writer.write(np.ones(1), 0)
        sample = reader.latest(after=900)
        assert sample is not None
        assert sample.index == 0


def test_the_header_states_rate_and_size(writer: RingWriter) -> None:
    with RingReader(writer.name) as reader:
        for number in range(101):
            writer.write(np.ones((2, 3), np.float32), number, arrived_ns=1 + 2_000_000 * number)
        stats = reader.stats()
        assert (stats.written, stats.shape, stats.dtype) == (101, (2, 3), "f4")
        assert (reader.pid, reader.closed) == (os.getpid(), False)
        assert stats.intervals.sum() == 100
        assert reader.alive


def test_a_closed_ring_is_absent_for_new_readers_and_readable_for_present_ones() -> None:
    writer = RingWriter(segment_name("test.ring", "psf"), 64)
    writer.write(np.ones(3), 4)
    with RingReader(writer.name) as reader:
        writer.close()
        writer.close()
        assert reader.closed
        assert not reader.alive
        sample = reader.latest()
        assert sample is not None
        assert sample.index == 4
    with pytest.raises(StreamUnavailable, match="has its server ended"):
        RingReader(writer.name)
    with pytest.raises(StreamUnavailable, match="the ring is closed"):
        writer.write(np.ones(3), 5)


def test_a_name_in_use_is_refused(writer: RingWriter) -> None:
    with pytest.raises(StorageError, match="File exists"):
        RingWriter(writer.name, 64)


def test_too_large_a_ring_is_refused_with_the_way_out() -> None:
    with pytest.raises(StorageError, match="escape streams --reap"):
        RingWriter(segment_name("test.ring", "frames"), 1 << 50)
    assert segments.segments(pid=os.getpid()) == ()


@pytest.mark.parametrize("name", ["../etc/passwd", "escape-0-x", "psm_12345", "escape-0-a/b-1-x"])
def test_other_names_are_refused(name: str) -> None:
    with pytest.raises(StreamUnavailable, match="is not the name of a segment"):
        RingReader(name)


def test_foreign_content_and_another_version_are_refused(writer: RingWriter) -> None:
    path = segments.SHARED / segment_name("test.ring", "foreign")
    try:
        path.write_bytes(b"\0" * 9000)
        with pytest.raises(StreamUnavailable, match="is not a stream of ESCAPE"):
            RingReader(path.name)
        assert segments.read_identity(path.name) is None
        content = bytearray((segments.SHARED / writer.name).read_bytes())
        content[8] = 99
        path.write_bytes(content)
        with pytest.raises(StreamUnavailable, match="version 99, this program reads version 1"):
            RingReader(path.name)
        content[8] = segments.SCHEMA
        path.write_bytes(content[:-1])
        with pytest.raises(StreamUnavailable, match="does not have the size"):
            RingReader(path.name)
    finally:
        path.unlink(missing_ok=True)


def test_no_link_is_followed(writer: RingWriter) -> None:
    path = segments.SHARED / segment_name("test.ring", "link")
    path.symlink_to(segments.SHARED / writer.name)
    try:
        with pytest.raises(StreamUnavailable):
            RingReader(path.name)
        assert segments.read_identity(path.name) is None
    finally:
        path.unlink()
