"""Rings between processes: no torn reads and no leaks, whichever process ends."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import pytest

from escape_hw.streams import segments
from escape_hw.streams.ring import RingReader, RingWriter
from escape_hw.streams.segments import segment_name
from escape_hw.supervision import process_start

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="shared memory as on Linux")

#: Of this process alone: the same tests may run beside it.
SYSTEM = f"test.processes-{os.getpid()}"
#: Writes frames that are the same number all over, as fast as it can; says its name first.
WRITER = f"""
import itertools, sys
import numpy as np
from escape_hw.streams.ring import RingWriter
from escape_hw.streams.segments import segment_name
writer = RingWriter(segment_name({SYSTEM!r}, "frames"), 1280 * 1024 * 2, slots=int(sys.argv[1]))
print(writer.name, flush=True)
frame = np.zeros((1024, 1280), np.uint16)
for index in itertools.count():
    frame.fill(index & 0xFFFF)
    writer.write(frame, index)
"""
READER = """
import sys, time
from escape_hw.streams.ring import RingReader
reader = RingReader(sys.argv[1])
print(reader.latest().index, flush=True)
if sys.argv[2] == "stay":
    time.sleep(600)
"""


@contextmanager
def process(script: str, *arguments: str) -> Iterator[subprocess.Popen[str]]:
    """A process of Python; killed in the end."""
    command = [sys.executable, "-c", script, *arguments]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as started:
        try:
            yield started
        finally:
            started.kill()


def says(started: subprocess.Popen[str]) -> str:
    assert started.stdout is not None
    return started.stdout.readline().strip()


# With two slots the reader is overtaken all the time, with eight hardly ever.
@pytest.mark.parametrize("slots", [2, 8])
@pytest.mark.slow
def test_no_frame_is_torn_at_full_speed(slots: int) -> None:
    with process(WRITER, str(slots)) as writer, RingReader(says(writer)) as reader:
        index, read, torn, again = -1, 0, 0, 0
        until = time.monotonic() + 2.0
        while time.monotonic() < until:
            sample = reader.latest(index)
            if sample is None:
                continue
            read += 1
            torn += sample.data.min() != sample.data.max() or int(sample.data[0, 0]) != sample.index & 0xFFFF
            again += sample.index <= index
            index = sample.index
        assert torn == 0
        assert again == 0
        # Both took part: this proves nothing otherwise.
        assert read > 20
        assert reader.written >= read
    assert [one.pid for one in segments.remove_orphaned(writer.pid)] == [writer.pid]


def test_a_recorder_in_another_process_gets_frames_whole_and_counts_the_rest() -> None:
    with process(WRITER, "8") as writer, RingReader(says(writer)) as reader:
        reader.seek_newest()
        first, last, got, until = reader.position, -1, 0, time.monotonic() + 1.0
        while time.monotonic() < until:
            sample = reader.next()
            if sample is not None:
                got += 1
                assert sample.index > last
                assert sample.data.min() == sample.data.max() == sample.index & 0xFFFF
                last = sample.index
        assert got > 20
        assert reader.position == first + got + reader.missed
    segments.remove_orphaned(writer.pid)


@pytest.mark.parametrize("end", ["exit", "kill"])
def test_the_end_of_a_reader_affects_no_other_process(end: str) -> None:
    with RingWriter(segment_name(SYSTEM, "slopes"), 64) as writer, RingReader(writer.name) as other:
        writer.write(np.ones(4), 1)
        with process(READER, writer.name, "go" if end == "exit" else "stay") as reader:
            assert says(reader) == "1"
            if end == "kill":
                assert segments.readers([writer.name]) == {writer.name: (reader.pid,)}
                reader.send_signal(signal.SIGKILL)
            reader.wait(30)
        assert [one.name for one in segments.segments(SYSTEM, os.getpid())] == [writer.name]
        assert segments.remove_orphaned(os.getpid()) == ()
        writer.write(np.ones(4), 2)
        sample = other.latest()
        assert sample is not None
        assert sample.index == 2
        assert other.alive


def test_the_segments_of_a_killed_owner_are_reaped_and_no_others() -> None:
    with RingWriter(segment_name(SYSTEM, "modes"), 64) as mine, process(WRITER, "8") as dead:
        name = says(dead)
        with RingReader(name) as reader:
            dead.send_signal(signal.SIGKILL)
            dead.wait(30)
            assert not reader.alive
            assert not reader.closed
        found = {one.name: one.alive for one in segments.segments(SYSTEM)}
        assert found[name] is False
        assert found[mine.name] is True
        assert name in [one.name for one in segments.remove_orphaned()]
        assert segments.read_identity(name) is None
        assert segments.read_identity(mine.name) is not None


def test_a_process_number_that_came_round_again_is_not_taken_for_the_owner() -> None:
    name = segment_name(SYSTEM, "psf")
    began = process_start(os.getpid())
    assert began is not None
    with RingWriter(name, 64):
        content = bytearray((segments.SHARED / name).read_bytes())
    segments.IDENTITY.pack_into(content, 0, segments.MAGIC, segments.SCHEMA, os.getpid(), began - 1)
    (segments.SHARED / name).write_bytes(content)
    found = segments.read_identity(name)
    assert found is not None
    assert not found.alive
    # The name is free for its new bearer.
    with RingWriter(name, 64) as writer, RingReader(name) as reader:
        writer.write(np.ones(1), 3)
        assert reader.alive


def test_a_forked_child_does_not_remove_its_parents_segment() -> None:
    script = f"""
import os, sys
from escape_hw.streams.ring import RingWriter
from escape_hw.streams.segments import read_identity, segment_name
with RingWriter(segment_name({SYSTEM!r}, "frames"), 64) as writer:
    child = os.fork()
    if child:
        os.waitpid(child, 0)
        print(read_identity(writer.name) is not None, flush=True)
"""
    with process(script) as parent:
        assert says(parent) == "True"
        assert parent.wait(30) == 0
    assert segments.segments(SYSTEM) == ()
