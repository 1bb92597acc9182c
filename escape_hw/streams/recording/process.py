"""A recorder in a process of its own, which ends with its parent."""

from __future__ import annotations

import json
import logging
import math
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path

from escape_hw.errors import StorageError
from escape_hw.streams.recording.recorder import RecordingProgress, StreamRecorder
from escape_hw.supervision import BackgroundThread, ChildProcess, watch_standard_input

log = logging.getLogger(__name__)

#: Seconds that a recorder may take to write its queue.
_STOP_TIMEOUT_S = 10.0
#: Lower priority than a loop, higher than displays.
_NICE = 5


class RecorderProcess:
    """A :class:`~escape_hw.streams.recording.recorder.StreamRecorder` in another process.

    It ends by itself after ``seconds``, if given. Raises ``StorageError`` if the process cannot be started.
    """

    def __init__(self, folder: Path, streams: Mapping[str, str], *, seconds: float | None = None) -> None:
        self.folder, self.seconds = folder, seconds
        self._state = RecordingProgress()
        request = {"folder": str(folder), "streams": dict(streams), "seconds": seconds}
        try:
            self._process = ChildProcess(
                __name__, json.dumps(request), stdin=subprocess.PIPE, stdout=subprocess.PIPE
            )
        except OSError as error:
            raise StorageError(f"{folder}: the recorder cannot be started ({error})") from error
        self._listener = BackgroundThread("recorder state", self._listen)
        self._listener.start()

    @property
    def state(self) -> RecordingProgress:
        """Progress about a second ago."""
        return self._state

    @property
    def running(self) -> bool:
        """Whether the process has not ended."""
        return self._process.running

    def stop(self) -> RecordingProgress:
        """Let the process write its queue and end; returns the final state. May be repeated."""
        self._process.stdin.close()
        if not self._process.wait_or_kill(_STOP_TIMEOUT_S):
            self._state.fault = (
                f"{self.folder}: the recorder did not end within {_STOP_TIMEOUT_S:g} s; check the disk"
            )
        self._listener.join(_STOP_TIMEOUT_S)
        return self._state

    def _listen(self) -> None:
        """Read the states that the process prints, until it ends."""
        with self._process.stdout as out:
            for line in out:
                self._state = RecordingProgress(**json.loads(line))
        if (code := self._process.wait()) and not self._state.fault:
            self._state.fault = f"{self.folder}: the recorder ended with code {code}"
            log.error(self._state.fault)


def main() -> None:
    """Record what the command line says until standard input ends."""
    os.nice(_NICE)
    request = json.loads(sys.argv[1])
    stop = watch_standard_input()

    def print_state(state: RecordingProgress) -> None:
        try:
            # Not through sys.stdout: its buffer is flushed at exit, which fails when the reader is gone.
            os.write(1, json.dumps(asdict(state)).encode() + b"\n")
        except BrokenPipeError:
            stop.set()

    recorder = StreamRecorder(Path(request["folder"]), request["streams"])
    end_s = math.inf if request["seconds"] is None else time.monotonic() + request["seconds"]
    recorder.run(lambda: stop.is_set() or time.monotonic() > end_s, print_state)


if __name__ == "__main__":
    main()
