"""Starts and stops the recording of telemetry."""

from __future__ import annotations

import logging
from pathlib import Path

from escape_hw.errors import RequestRefused
from escape_hw.io.run_folder import dated_folder
from escape_hw.io.storage import check_writable, make_folder
from escape_hw.remote.state import RecordingState
from escape_hw.server.engine.publisher import StreamPublisher
from escape_hw.streams.recording.process import RecorderProcess

log = logging.getLogger(__name__)

#: The streams with an entry for every frame.
_RECORDED_STREAMS = ("frames", "slopes", "modes", "commands", "psf")


class TelemetryRecording:
    """Records the streams at full rate, in a process that the loop does not wait for."""

    def __init__(self, runs: Path, publisher: StreamPublisher) -> None:
        self._runs, self._publisher = runs, publisher
        self._process: RecorderProcess | None = None
        self._last = RecordingState()

    def set_recording(self, on: bool) -> RecordingState:
        """Start or stop; does nothing when the recording is in that state already.

        RequestRefused when there is no stream yet; StorageError when folder or process are not available.
        """
        if on and self._process is None:
            self._start()
        elif not on and self._process is not None:
            process = self._process
            self._last = self.state().model_copy(update={"recording": False})
            self._process = None
            end = process.stop()
            self._last = RecordingState(path=str(process.folder), written=end.written, dropped=end.dropped)
            log.info("recorded %d entries in %s, %d dropped", end.written, process.folder, end.dropped)
        return self.state()

    def _start(self) -> None:
        segments = {one.name: one.segment for one in self._publisher.entries if one.name in _RECORDED_STREAMS}
        if not segments:
            raise RequestRefused("there is nothing to record yet; wait for the first frame")
        folder = dated_folder(self._runs, "telemetry")
        make_folder(folder)
        check_writable(folder)
        self._process = RecorderProcess(folder, segments)
        log.info("recording %s in %s", ", ".join(segments), folder)

    def state(self) -> RecordingState:
        """Progress of the recording, or how the last one ended."""
        process = self._process
        if process is None:
            return self._last
        now = process.state
        state = RecordingState(
            recording=True, path=str(process.folder), written=now.written, dropped=now.dropped
        )
        if now.fault or not process.running:
            fault = now.fault or "the recorder process ended"
            log.error("recording ended: %s", fault)
            self._process = None
            self._last = state = state.model_copy(update={"recording": False, "fault": fault})
        return state
