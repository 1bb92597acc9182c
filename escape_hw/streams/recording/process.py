"""A recorder in a process of its own: started, asked how far it is, and stopped.

It ends by itself when whoever started it is gone: its standard input ends then.
"""

from __future__ import annotations

import json
import logging
import os
import subprocess
import sys
import threading
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from escape_hw.errors import StorageError
from escape_hw.streams.recording.recorder import MIN_FREE_BYTES, RecordingState, StreamRecorder

log = logging.getLogger(__name__)

#: Seconds that a recorder may take to write what it has.
_STOP_TIMEOUT_S = 10.0
#: Behind a loop, before screens: what it misses for a tenth of a second is not recorded.
_NICE = 5


class RecorderProcess:
    """Records streams in another process.

    Parameters
    ----------
    folder, streams, least_free
        As for :class:`~escape_hw.streams.recording.recorder.StreamRecorder`.
    """

    def __init__(self, folder: Path, streams: Mapping[str, str], *, least_free: int = MIN_FREE_BYTES) -> None:
        self.folder = folder
        self._state = RecordingState()
        request = json.dumps({"folder": str(folder), "streams": dict(streams), "least_free": least_free})
        try:
            self._process = subprocess.Popen(
                [sys.executable, "-m", __name__, request],
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, start_new_session=True,
            )  # fmt: skip
        except OSError as error:
            raise StorageError(f"{folder}: no recorder can be started ({error})") from error
        self._listener = threading.Thread(target=self._listen, name="recorder's word", daemon=True)
        self._listener.start()

    @property
    def state(self) -> RecordingState:
        """How far it was about a second ago."""
        return self._state

    @property
    def running(self) -> bool:
        """Whether it still records."""
        return self._process.poll() is None

    def stop(self) -> RecordingState:
        """Let it write what it has, and end it. Returns how far it came; may be repeated."""
        process = self._process
        if process.stdin is not None:
            process.stdin.close()
        try:
            process.wait(_STOP_TIMEOUT_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
            self._state.fault = (
                f"{self.folder}: the recorder did not end within {_STOP_TIMEOUT_S:g} s; was the disk stuck?"
            )
        self._listener.join(_STOP_TIMEOUT_S)
        return self._state

    def _listen(self) -> None:
        """Take its word, line by line; in a thread."""
        out = self._process.stdout
        if out is None:
            return
        with out:
            for line in out:
                self._state = RecordingState(**json.loads(line))
        if self._process.wait() and not self._state.fault:
            self._state.fault = f"{self.folder}: the recorder ended with code {self._process.returncode}"
            log.error(self._state.fault)


def main() -> None:
    """Record what the command line says until standard input ends."""
    os.nice(_NICE)
    request = json.loads(sys.argv[1])
    stop_event = threading.Event()

    def wait_for_eof() -> None:
        sys.stdin.read()
        stop_event.set()

    def print_state(state: RecordingState) -> None:
        try:
            print(json.dumps(asdict(state)), flush=True)
        except BrokenPipeError:
            # Nobody listens any more.
            stop_event.set()

    threading.Thread(target=wait_for_eof, daemon=True).start()
    recorder = StreamRecorder(Path(request["folder"]), request["streams"], least_free=request["least_free"])
    recorder.run(stop_event.is_set, print_state)


if __name__ == "__main__":
    main()
