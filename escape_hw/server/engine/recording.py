"""Switches the recording of telemetry on and off."""

from __future__ import annotations

import logging
from datetime import datetime
from pathlib import Path

from escape_hw.errors import RequestRefused
from escape_hw.io.storage import check_writable, make_folder
from escape_hw.remote.state import RecordingState
from escape_hw.server.engine.publisher import StreamPublisher
from escape_hw.streams.recording.process import RecorderProcess

log = logging.getLogger(__name__)

#: The streams with an entry for every frame.
_EVERY_FRAME = ("frames", "slopes", "modes", "commands", "psf")


class TelemetryRecording:
    """Records what passes, at full rate, in a process that nobody waits for.

    Parameters
    ----------
    runs
        Folder under which recordings go.
    publisher
        Whose streams are recorded: those that there are when it is switched on.
    """

    def __init__(self, runs: Path, publisher: StreamPublisher) -> None:
        self._runs, self._publisher = runs, publisher
        self._process: RecorderProcess | None = None
        self._last = RecordingState()

    def set_recording(self, on: bool) -> RecordingState:
        """Begin or end; does nothing when it is so already.

        Raises
        ------
        RequestRefused
            Nothing passes yet that could be recorded.
        StorageError
            The folder takes no files, or no process can be had.
        """
        if on and self._process is None:
            self._begin()
        elif not on and self._process is not None:
            process = self._process
            self._last = self.state().model_copy(update={"recording": False})
            self._process = None
            end = process.stop()
            self._last = RecordingState(path=str(process.folder), written=end.written, dropped=end.dropped)
            log.info("recorded %d entries in %s, %d dropped", end.written, process.folder, end.dropped)
        return self.state()

    def _begin(self) -> None:
        found = {one.name: one.segment for one in self._publisher.entries if one.name in _EVERY_FRAME}
        if not found:
            raise RequestRefused("there is nothing to record yet; wait for the first frame")
        now = datetime.now().astimezone()
        folder = self._runs / f"{now:%Y-%m-%d}" / f"{now:%H%M%S}_telemetry"
        make_folder(folder)
        check_writable(folder)
        self._process = RecorderProcess(folder, found)
        log.info("recording %s in %s", ", ".join(found), folder)

    def state(self) -> RecordingState:
        """How far it is."""
        process = self._process
        if process is None:
            return self._last
        recorder_state = process.state
        if recorder_state.fault or not process.running:
            fault = recorder_state.fault or "its process has gone"
            log.error("recording ended: %s", fault)
            self._process = None
            self._last = RecordingState(
                path=str(process.folder),
                written=recorder_state.written,
                dropped=recorder_state.dropped,
                fault=fault,
            )
            return self._last
        return RecordingState(
            recording=True,
            path=str(process.folder),
            written=recorder_state.written,
            dropped=recorder_state.dropped,
        )
