"""Publishes frames, slopes, commands and results in shared memory, and records them."""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.callbacks import Callbacks
from escape_hw.api.camera import Frame
from escape_hw.api.sensor import SensorGeometry
from escape_hw.errors import RequestRefused, StorageError
from escape_hw.io.run_folder import dated_folder
from escape_hw.io.storage import check_writable, make_folder
from escape_hw.remote.source import STREAMS
from escape_hw.remote.state import RecordingState, StreamEntry
from escape_hw.runtime.session.recordings import RecordingDescription, write_description
from escape_hw.streams.recording.process import RecorderProcess
from escape_hw.streams.recording.recorder import RecordingProgress
from escape_hw.streams.ring import SLOTS, RingWriter
from escape_hw.streams.segments import segment_name

log = logging.getLogger(__name__)

#: Least capacity of a ring's entry, so that growing arrays seldom need a new ring.
_MIN_BYTES = 16384
#: Entries kept of streams that are recorded at full rate; they bridge delays of the recorder.
_SLOTS = {"frames": 16, "slopes": 64, "residual_modes": 64, "commands": 64}


class StreamPublisher:
    """One ring per stream, created with its first entry. ``system`` is part of the segments' names.

    Attributes
    ----------
    latest_frame, latest_command
        The newest frame and command ``(n_act,)``, fraction of full stroke; ``None`` before the first.
    frames, commands
        Counts.
    grid, geometry_version
        The sensor's geometry, ``None`` before it was measured, and a number that changes with it.
    residual_nm
        Newest rms residual of a closed loop; 0 before the first.
    """

    def __init__(self, system: str) -> None:
        self._system = system
        self._rings: dict[str, RingWriter] = {}
        self._failed_streams: set[str] = set()
        self.latest_frame: Frame | None = None
        self.latest_command: NDArray[np.float64] | None = None
        self.frames = self.commands = 0
        self.residual_nm = 0.0
        self.grid: SensorGeometry | None = None
        self.geometry_version = 0
        self._full_scale_meta = self._science_meta = b""

    def set_full_scale(self, counts: float, science: float | None = None) -> None:
        """Set the values at which pixels of the cameras are saturated; part of every frame's entry."""
        # "top" is the key of version 0.1.0; version 0.3.0 removes it.
        self._full_scale_meta = json.dumps({"full_scale": counts, "top": counts}).encode()
        self._science_meta = b"" if science is None else json.dumps({"full_scale": science}).encode()

    @property
    def callbacks(self) -> Callbacks:
        """Callbacks for the bench."""
        return Callbacks(
            frame=self._frame, science=self._science, slopes=self._slopes, command=self._command,
            residual=self._residual, geometry=self.set_geometry,
        )  # fmt: skip

    @property
    def entries(self) -> tuple[StreamEntry, ...]:
        """The streams that have an entry."""
        return tuple(
            StreamEntry(name=name, segment=ring.name, unit=STREAMS[name])
            for name, ring in tuple(self._rings.items())
        )

    def remove_stream(self, name: str) -> None:
        """Remove a stream whose content is no longer valid."""
        ring = self._rings.pop(name, None)
        if ring is not None:
            ring.close()

    def set_geometry(self, grid: SensorGeometry | None) -> None:
        """Store the sensor's geometry; ``None`` when it is no longer valid."""
        if grid is not self.grid:
            self.grid = grid
            self.geometry_version += 1

    def publish_arrays(self, arrays: Mapping[str, NDArray[Any]], **meta: float | str) -> None:
        """Publish arrays of a procedure under their streams' names; arrays that are no stream are ignored."""
        text = json.dumps(meta).encode()[:256] if meta else b""
        for name in STREAMS.keys() & arrays.keys():
            array = np.ascontiguousarray(arrays[name])
            ring = self._ring(name, array)
            if ring is not None:
                ring.write(array, ring.written, meta=text)

    def close(self) -> None:
        """Remove the segments."""
        for ring in self._rings.values():
            ring.close()
        self._rings.clear()

    def _ring(self, name: str, data: NDArray[Any]) -> RingWriter | None:
        """The ring of a stream, large enough for an array; ``None`` when there is no memory for it."""
        ring = self._rings.get(name)
        if ring is not None and data.nbytes <= ring.capacity:
            return ring
        if name in self._failed_streams:
            return None
        room = max(_MIN_BYTES, data.nbytes if ring is None else 2 * data.nbytes)
        if ring is not None:
            # Its readers notice that it is closed and open the new one under the same name.
            del self._rings[name]
            ring.close()
        try:
            self._rings[name] = RingWriter(segment_name(self._system, name), room, _SLOTS.get(name, SLOTS))
        except StorageError as error:
            log.error("stream '%s' cannot be published: %s", name, error)
            self._failed_streams.add(name)
            return None
        return self._rings[name]

    def _frame(self, frame: Frame) -> None:
        self.latest_frame = frame
        self.frames += 1
        self._write("frames", frame.data, frame.index, frame.exposed_ns, self._full_scale_meta)

    def _science(self, frame: Frame) -> None:
        self._write("psf", frame.data, frame.index, frame.exposed_ns, self._science_meta)

    def _slopes(self, index: int, slopes: NDArray[np.float32]) -> None:
        self._write("slopes", slopes, index)

    def _command(self, command: NDArray[np.float64]) -> None:
        self.latest_command = command
        self.commands += 1
        self._write("commands", command, self.commands)

    def reset_residual(self) -> None:
        """Discard the residual of the previous loop."""
        self.residual_nm = 0.0

    def _residual(self, index: int, modes: NDArray[np.float32], rms: float) -> None:
        self.residual_nm = rms
        self._write("residual_modes", modes, index)

    def _write(
        self, name: str, data: NDArray[Any], index: int, exposed_ns: int = 0, meta: bytes = b""
    ) -> None:
        ring = self._ring(name, data)
        if ring is not None:
            ring.write(data, index, exposed_ns, time.monotonic_ns(), meta)


#: The streams with an entry for every frame, and those of them with images.
_RECORDED_STREAMS = ("frames", "slopes", "residual_modes", "commands", "psf")
_IMAGE_STREAMS = ("frames", "psf")


class TelemetryRecording:
    """Records the streams at full rate, in a process that the loop does not wait for.

    ``describe`` returns what an analysis of a recording needs to know about bench and loop.
    """

    def __init__(
        self, runs: Path, publisher: StreamPublisher, describe: Callable[[], RecordingDescription]
    ) -> None:
        self._runs, self._publisher, self._describe = runs, publisher, describe
        self._process: RecorderProcess | None = None
        self._last = RecordingState()

    def set_recording(self, on: bool, *, images: bool = True, seconds: float | None = None) -> RecordingState:
        """Start or stop; does nothing when the recording is in that state already.

        RequestRefused when there is no stream yet; StorageError when folder or process are not available.
        """
        if on and self._process is None:
            self._start(images, seconds)
        elif not on and self._process is not None:
            self._finish(self._process)
        return self.state()

    def _start(self, images: bool, seconds: float | None) -> None:
        chosen = [name for name in _RECORDED_STREAMS if images or name not in _IMAGE_STREAMS]
        segments = {one.name: one.segment for one in self._publisher.entries if one.name in chosen}
        if not segments:
            raise RequestRefused("there is nothing to record yet; wait for the first frame")
        folder = dated_folder(self._runs, "telemetry")
        make_folder(folder)
        check_writable(folder)
        description = self._describe()
        write_description(folder, description)
        self._last = RecordingState(path=str(folder), started_utc=description.started_utc)
        self._process = RecorderProcess(folder, segments, seconds=seconds)
        log.info("recording %s in %s", ", ".join(segments), folder)

    def _finish(self, process: RecorderProcess) -> None:
        """Wait until everything is on disk; the state is that of the end."""
        # What another thread publishes meanwhile: it records, with the entries written so far.
        self._last = self._progress(process.state)
        self._process = None
        end = process.stop()
        self._last = self._progress(end).model_copy(update={"recording": False})
        log.info("recorded %d entries in %s, %d dropped", end.written, process.folder, end.dropped)

    def _progress(self, now: RecordingProgress) -> RecordingState:
        return self._last.model_copy(
            update={
                "recording": True, "written": now.written, "dropped": now.dropped, "size": now.size,
                "fault": now.fault,
            }
        )  # fmt: skip

    def state(self) -> RecordingState:
        """Progress of the recording, or how the last one ended."""
        process = self._process
        if process is None:
            return self._last
        if process.running and not process.state.fault:
            return self._progress(process.state)
        is_complete = process.seconds is not None and not process.state.fault
        self._finish(process)
        if not is_complete:
            fault = self._last.fault or "the recorder process ended"
            log.error("recording ended: %s", fault)
            self._last = self._last.model_copy(update={"fault": fault})
        return self._last
