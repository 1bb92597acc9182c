"""Telemetry on disk: every entry in order, or counted as dropped; a slow or full disk delays no loop."""

from __future__ import annotations

import errno
import io
import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from escape_hw.cli import main
from escape_hw.errors import ProductError
from escape_hw.remote.state import RecordingState
from escape_hw.server.engine.publisher import TelemetryRecording
from escape_hw.streams import segments
from escape_hw.streams.recording import recorder as module
from escape_hw.streams.recording.block_file import HEADER, read_recording, write_block
from escape_hw.streams.recording.process import RecorderProcess
from escape_hw.streams.recording.recorder import RecordingProgress, StreamRecorder
from escape_hw.streams.ring import RingReader, RingWriter
from escape_hw.streams.segments import segment_name

pytestmark = pytest.mark.skipif(not sys.platform.startswith("linux"), reason="shared memory as on Linux")

SYSTEM = f"test.recorder-{os.getpid()}"
#: Enough for a machine that is busy with other things.
SLOTS = 1024


@pytest.fixture
def writer() -> Iterator[RingWriter]:
    with RingWriter(segment_name(SYSTEM, "slopes"), 800, slots=SLOTS) as made:
        yield made


def entries(writer: RingWriter, first: int, count: int, *, size: int = 100, wait_s: float = 0.0) -> None:
    for index in range(first, first + count):
        writer.write(np.full(size, index, np.float32), index, exposed_ns=10 * index)
        if wait_s:
            time.sleep(wait_s)


@contextmanager
def recording(tmp_path, writer, **options):
    """A recorder that runs in a thread until the end of the block."""
    stop = threading.Event()
    recorder = StreamRecorder(tmp_path, {"slopes": writer.name}, **options)
    thread = threading.Thread(target=recorder.run, args=(stop.is_set,))
    thread.start()
    yield recorder
    stop.set()
    thread.join(30)
    assert not thread.is_alive()


def recorded(tmp_path, writer, produce, **options):
    """Record in a thread while ``produce`` runs."""
    with recording(tmp_path, writer, **options) as recorder:
        produce()
    return recorder.state


def test_every_entry_is_read_back(tmp_path, writer):
    entries(writer, 0, 10)
    state = recorded(tmp_path, writer, lambda: entries(writer, 10, 500, wait_s=0.0005))
    assert (state.written, state.dropped, state.fault) == (500, 0, "")
    (part,) = read_recording(tmp_path / "slopes.blocks")
    assert part.complete
    np.testing.assert_array_equal(part.index, np.arange(10, 510))
    np.testing.assert_array_equal(part.exposed_ns, 10 * np.arange(10, 510))
    assert (np.diff(part.arrived_ns) > 0).all()
    assert part.data.dtype == np.float32
    np.testing.assert_array_equal(part.data, np.repeat(np.arange(10, 510), 100).reshape(500, 100))
    assert state.size == (tmp_path / "slopes.blocks").stat().st_size


def test_entries_of_other_shapes_make_parts(tmp_path, writer):
    def produce():
        entries(writer, 0, 20)
        entries(writer, 20, 30, size=7)
        writer.write(np.ones((2, 3), np.uint16), 50)

    state = recorded(tmp_path, writer, produce)
    parts = read_recording(tmp_path / "slopes.blocks")
    assert [part.data.shape for part in parts] == [(20, 100), (30, 7), (1, 2, 3)]
    assert state.written == 51


def test_what_was_overwritten_is_counted(tmp_path, writer):
    stop = threading.Event()
    recorder = StreamRecorder(tmp_path, {"slopes": writer.name})
    entries(writer, 0, 3 * SLOTS)
    stop.set()
    state = recorder.run(stop.is_set)
    assert state.dropped == 2 * SLOTS + 1
    assert state.written == SLOTS - 1
    (part,) = read_recording(tmp_path / "slopes.blocks")
    np.testing.assert_array_equal(part.index, np.arange(2 * SLOTS + 1, 3 * SLOTS))


def test_memory_is_bounded_when_the_disk_stands_still(tmp_path, writer, monkeypatch):
    going_on = threading.Event()

    def stuck(*block):
        going_on.wait(30)
        return 0

    monkeypatch.setattr(module, "write_block", stuck)
    monkeypatch.setattr(module, "_BLOCK_BYTES", 4000)
    monkeypatch.setattr(module, "MAX_QUEUED_BYTES", 20_000)

    with recording(tmp_path, writer) as recorder:
        entries(writer, 0, 800, wait_s=0.0002)
        # Five blocks of ten entries wait at most, and none of the others stopped the writer.
        _until(lambda: recorder.state.dropped >= 700)
        going_on.set()
    state = recorder.state
    assert state.written + state.dropped == 800
    assert state.fault == ""


def test_a_full_disk_ends_the_recording_and_leaves_whole_blocks(tmp_path, writer, monkeypatch):
    real, blocks = module.write_block, []

    def full(file, head, data):
        blocks.append(len(head))
        if len(blocks) == 3:
            file.write(b"half a block")
            raise OSError(errno.ENOSPC, "No space left on device")
        return real(file, head, data)

    monkeypatch.setattr(module, "write_block", full)
    monkeypatch.setattr(module, "_BLOCK_BYTES", 4000)
    state = recorded(tmp_path, writer, lambda: entries(writer, 0, 300, wait_s=0.0005))
    assert "No space left on device; free some space" in state.fault
    assert state.written == sum(blocks[:2])
    (part,) = read_recording(tmp_path / "slopes.blocks")
    np.testing.assert_array_equal(part.index, np.arange(state.written))
    assert not part.complete


def test_room_is_left_to_others(tmp_path, writer):
    with recording(tmp_path, writer, min_free_bytes=1 << 60) as recorder:
        _until(lambda: recorder.state.fault)
    assert "below the limit of" in recorder.state.fault


class SmallDisk(io.FileIO):
    """A file that takes a few bytes at a time, and only so many."""

    def write(self, content):
        if self.tell() > 3000:
            raise OSError(errno.ENOSPC, "No space left on device")
        return super().write(content[:100])


def test_half_a_block_is_taken_back_when_the_disk_is_full(tmp_path):
    path = tmp_path / "small.blocks"
    block = np.zeros(10, HEADER), np.ones((10, 20), np.float32)
    with SmallDisk(path, "w") as file:
        size = write_block(file, *block)
        while file.tell() < 3000 - size:
            write_block(file, *block)
        with pytest.raises(OSError, match="No space left"):
            write_block(file, *[np.concatenate([part] * 3) for part in block])
    complete = path.stat().st_size // size
    assert path.stat().st_size == complete * size
    (part,) = read_recording(path)
    assert (len(part.data), part.complete) == (10 * complete, True)


def test_damage_is_reported(tmp_path, writer):
    recorded(tmp_path, writer, lambda: entries(writer, 0, 50))
    content = (tmp_path / "slopes.blocks").read_bytes()
    (tmp_path / "cut.blocks").write_bytes(content[: len(content) - 5])
    with pytest.raises(ProductError, match="no complete block"):
        read_recording(tmp_path / "cut.blocks")
    (tmp_path / "two.blocks").write_bytes(content + content[:-5])
    (part,) = read_recording(tmp_path / "two.blocks")
    assert (len(part.data), part.complete) == (50, False)
    np.save(tmp_path / "other.npy", np.zeros((4, 4)))
    (tmp_path / "foreign.blocks").write_bytes((tmp_path / "other.npy").read_bytes() * 2)
    with pytest.raises(ProductError, match="not a recording"):
        read_recording(tmp_path / "foreign.blocks")
    with pytest.raises(ProductError, match="cannot be read"):
        read_recording(tmp_path / "none.blocks")


def _until(true, seconds=20.0):
    end = time.monotonic() + seconds
    while not true() and time.monotonic() < end:
        time.sleep(0.02)
    assert true()


def test_a_process_records_beside_its_writer(tmp_path, writer):
    recorder = RecorderProcess(tmp_path, {"slopes": writer.name})
    path, sent = tmp_path / "slopes.blocks", 0
    try:
        _until(path.exists)
        while recorder.state.written == 0 and sent < 20_000:
            entries(writer, sent, 10, wait_s=0.001)
            sent += 10
        assert recorder.running
    finally:
        state = recorder.stop()
    assert state == recorder.stop()
    assert (state.fault, state.dropped) == ("", 0)
    (part,) = read_recording(path)
    assert len(part.index) == state.written
    assert (np.diff(part.index) == 1).all()
    assert part.index[-1] == sent - 1
    assert not recorder.running


def test_a_process_ends_with_its_streams(tmp_path):
    writer = RingWriter(segment_name(SYSTEM, "modes"), 800)
    recorder = RecorderProcess(tmp_path, {"modes": writer.name})
    try:
        _until((tmp_path / "modes.blocks").exists)
        writer.close()
        _until(lambda: not recorder.running)
    finally:
        state = recorder.stop()
    assert state.fault == ""


def test_a_process_ends_after_its_time(tmp_path, writer):
    recorder = RecorderProcess(tmp_path, {"slopes": writer.name}, seconds=0.3)
    _until((tmp_path / "slopes.blocks").exists)
    entries(writer, 0, 10, wait_s=0.001)
    _until(lambda: not recorder.running)
    assert (recorder.stop().fault, recorder.stop().written) == ("", 10)


def test_a_process_that_cannot_begin_is_reported(tmp_path, capfd):
    recorder = RecorderProcess(tmp_path, {"slopes": segment_name(SYSTEM, "absent")})
    _until(lambda: not recorder.running)
    assert "the recorder ended with code" in recorder.stop().fault
    assert "no such stream" in capfd.readouterr().err


def document(capsys) -> dict:
    return json.loads(capsys.readouterr().out)


def test_the_command_shows_what_flows(writer, capsys):
    stop = threading.Event()

    def produce():
        while not stop.is_set():
            entries(writer, writer.written, 1, wait_s=0.002)

    thread = threading.Thread(target=produce)
    thread.start()
    try:
        with pytest.raises(SystemExit) as ended, RingReader(writer.name):
            main(["streams", "--json", "--seconds", "0.5"])
        assert ended.value.code == 0
    finally:
        stop.set()
        thread.join()
    (row,) = (row for row in document(capsys)["streams"] if row["segment"] == writer.name)
    assert (row["system"], row["stream"]) == (SYSTEM, "slopes")
    assert row["alive"]
    assert row["shape"] == [100]
    assert row["dtype"] == "f4"
    assert 20 < row["rate_hz"] < 600
    assert 1500 < row["interval_us"]["p50"] < 50_000
    assert row["interval_us"]["p50"] <= row["interval_us"]["p99"] <= row["interval_us"]["max"]
    with pytest.raises(SystemExit):
        main(["streams", "--seconds", "0.1"])
    text = capsys.readouterr().out
    assert SYSTEM in text  # the names may stand on two lines
    assert "slopes" in text


def test_the_command_removes_segments_of_ended_processes_only(writer, capsys):
    script = f"""
import os, signal
from escape_hw.streams.ring import RingWriter
from escape_hw.streams.segments import segment_name
print(RingWriter(segment_name({SYSTEM!r}, "psf"), 64).name, flush=True)
os.kill(os.getpid(), signal.SIGKILL)
"""
    found = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    name = found.stdout.strip()
    assert segments.read_identity(name) is not None
    with pytest.raises(SystemExit):
        main(["streams", "--json", "--reap"])
    assert name in document(capsys)["removed"]
    assert segments.read_identity(name) is None
    assert segments.read_identity(writer.name) is not None


ORPHAN = """
import os, signal, sys, time
from pathlib import Path
import numpy as np
from escape_hw.streams.recording.process import RecorderProcess
from escape_hw.streams.ring import RingWriter
from escape_hw.streams.segments import segment_name
writer = RingWriter(segment_name(sys.argv[2], "slopes"), 800, 64)
recorder = RecorderProcess(Path(sys.argv[1]), {"slopes": writer.name})
index = 0
while recorder.state.written == 0:
    writer.write(np.full(100, float(index)), index)
    index += 1
    time.sleep(0.002)
os.kill(os.getpid(), signal.SIGKILL)
"""


def test_a_recorder_whose_parent_is_killed_prints_nothing(tmp_path: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-c", ORPHAN, str(tmp_path), SYSTEM], capture_output=True, text=True, timeout=60
    )
    assert done.returncode == -9
    assert done.stderr == ""


def test_a_recording_that_is_being_stopped_is_published_as_one_that_runs(tmp_path: Path) -> None:
    class Process:
        """A recorder that writes its queue while another thread publishes the state."""

        state, folder = RecordingProgress(written=700), tmp_path

        def stop(self) -> RecordingProgress:
            seen.append(recording.state())
            return RecordingProgress(written=900)

    seen: list[RecordingState] = []
    recording = TelemetryRecording(tmp_path, publisher=None, describe=None)
    recording._process = Process()
    ended = recording.set_recording(False)
    assert [(one.recording, one.written) for one in (*seen, ended)] == [(True, 700), (False, 900)]
