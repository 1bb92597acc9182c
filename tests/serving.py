"""A running ``escape serve``, with all its files in temporary folders."""

from __future__ import annotations

import os
import signal
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from running import ESCAPE

from escape_hw.errors import ServerGone
from escape_hw.remote.client import Connection, connect
from escape_hw.remote.state import Phase
from escape_hw.streams.segments import segments
from escape_hw.supervision import process_start

#: Longest wait for something that takes seconds on an idle machine.
PATIENCE_S = 120.0
#: A name of its own, so that what other tests leave in shared memory is not taken for ours.
SYSTEM = f"small-{os.getpid()}"


def wait_for(what: Callable[[], bool], why: str, patience_s: float = PATIENCE_S) -> float:
    """Wait until something is so; the seconds it took. Fails after a long while."""
    began = time.monotonic()
    while not what():
        assert time.monotonic() - began < patience_s, f"never happened: {why}"
        time.sleep(0.01)
    return time.monotonic() - began


class Served:
    """A server process.

    Parameters
    ----------
    words
        What follows ``escape serve``.
    folder
        Where its data, listing and sockets go.
    more
        What else its environment needs.
    """

    def __init__(
        self, words: tuple[object, ...], folder: Path, more: Mapping[str, str] | None = None
    ) -> None:
        self.folder, self._words, self._more = folder, words, dict(more or {})
        # Sockets are not put below a folder that others may change.
        for private in (folder, folder / "run"):
            private.mkdir(mode=0o700, parents=True, exist_ok=True)
        self.environment = {
            **os.environ, **self._more, "OPENBLAS_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1",
            "XDG_DATA_HOME": str(folder / "data"), "XDG_RUNTIME_DIR": str(folder / "run"),
        }  # fmt: skip
        self.log = folder / "serve.log"
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def pid(self) -> int:
        assert self._process is not None
        return self._process.pid

    @property
    def front(self) -> int:
        """Process of the front end; 0 while there is none."""
        words = ("-f", "escape_hw.server.frontend.main", "-P", str(self.pid))
        found = subprocess.run(("pgrep", *words), capture_output=True, text=True, check=False).stdout.split()
        return int(found[0]) if found else 0

    def start(self) -> None:
        """Start it; it is ready some seconds later."""
        with self.log.open("ab") as log:
            self._process = subprocess.Popen(
                [*ESCAPE, "serve", *map(str, self._words), "--set", f"system.name={SYSTEM}"],
                env=self.environment,
                stdout=log,
                stderr=log,
            )

    def connect(self, **options: bool) -> Connection:
        """Connect as soon as it listens."""
        os.environ["XDG_RUNTIME_DIR"] = self.environment["XDG_RUNTIME_DIR"]
        deadline = time.monotonic() + PATIENCE_S
        while True:
            try:
                return connect(SYSTEM, **options)
            except ServerGone:
                assert self._process is not None
                assert self._process.poll() is None, self.log.read_text()
                assert time.monotonic() < deadline, self.log.read_text()
                time.sleep(0.05)

    def kill(self, number: int = signal.SIGKILL) -> None:
        """Send the front end a signal."""
        os.kill(self.front, number)

    def stop(self) -> int:
        """End it in order."""
        assert self._process is not None
        if self._process.poll() is None:
            self._process.send_signal(signal.SIGINT)
        return self._process.wait(PATIENCE_S)

    def engines(self) -> list[int]:
        """Engines and fail-safe processes that run, of this server or of one before in the same folder."""
        mine = f"XDG_RUNTIME_DIR={self.environment['XDG_RUNTIME_DIR']}".encode()
        found = []
        for entry in Path("/proc").iterdir():
            if entry.name.isdigit() and process_start(int(entry.name)) is not None:
                try:
                    command = (entry / "cmdline").read_bytes()
                    if b"escape_hw.server." in command and mine in (entry / "environ").read_bytes():
                        found.append(int(entry.name))
                except OSError:
                    continue
        return found


@contextmanager
def serving(*words: object, folder: Path, more: Mapping[str, str] | None = None) -> Iterator[Served]:
    """A server, ended in the end; nothing of it may stay behind."""
    before = os.environ.get("XDG_RUNTIME_DIR")
    served = Served(words, folder, more)
    served.start()
    try:
        yield served
    finally:
        served.stop()
        if before is None:
            os.environ.pop("XDG_RUNTIME_DIR", None)
        else:
            os.environ["XDG_RUNTIME_DIR"] = before
    wait_for(lambda: not served.engines(), "engine and fail-safe process end")
    assert not [one for one in segments(SYSTEM) if not one.alive]


def until_idle(bench: Connection) -> None:
    """Wait until the engine is ready."""
    wait_for(lambda: bench.state.phase is Phase.IDLE, "the engine is idle")


class Spy:
    """Remembers the last command that a simulated bench's mirror got."""

    def __init__(self, bench: object) -> None:
        self._drive = bench.drive  # type: ignore[attr-defined]
        self.last: NDArray[np.float64] | None = None
        bench.drive = self  # type: ignore[attr-defined]

    def __call__(self, shape: NDArray[np.float64]) -> None:
        self.last = shape.copy()
        self._drive(shape)

    @property
    def flat(self) -> bool:
        return self.last is not None and not self.last.any()
