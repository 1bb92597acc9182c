"""Supervision of child processes and background threads. Standard library only."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import IO, Any

log = logging.getLogger(__name__)


# ---------------------------------------------------------------- processes
def process_start(pid: int) -> int | None:
    """Start time of a process in clock ticks after boot; ``None`` when it does not exist or is a zombie."""
    try:
        text = Path(f"/proc/{pid}/stat").read_text(encoding="ascii", errors="replace")
    except OSError:
        return None
    # The command's name is in brackets and may contain spaces and brackets.
    fields = text[text.rindex(")") + 2 :].split()
    return None if fields[0] in "ZX" else int(fields[19])


def is_alive(pid: int, started: int | None) -> bool:
    """Whether a process is alive. The start time distinguishes it from a later process of the same number."""
    return process_start(pid) == started


class ChildProcess:
    """A Python module that runs as a child process, ``python -m MODULE ARGUMENTS``, in a session of its own.

    Neither Ctrl-C nor the end of the terminal reaches it. ``options`` are those of :class:`subprocess.Popen`.

    Raises
    ------
    OSError
        The process cannot be started.
    """

    def __init__(self, module: str, *arguments: str, **options: Any) -> None:
        self._process: subprocess.Popen[bytes] = subprocess.Popen(
            [sys.executable, "-m", module, *arguments], start_new_session=True, **options
        )

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def stdin(self) -> IO[bytes]:
        """Standard input, when opened with ``stdin=PIPE``."""
        return _require_pipe(self._process.stdin)

    @property
    def stdout(self) -> IO[bytes]:
        """Standard output, when opened with ``stdout=PIPE``."""
        return _require_pipe(self._process.stdout)

    @property
    def running(self) -> bool:
        """Whether the process has not ended."""
        return self._process.poll() is None

    def wait(self, timeout_s: float | None = None) -> int | None:
        """Wait for the end; returns the exit code, or ``None`` when the process still runs."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            return self._process.wait(timeout_s)
        return None

    def wait_or_kill(self, timeout_s: float) -> bool:
        """Wait for the end and kill the process after the time-out; false when it was killed."""
        if self.wait(timeout_s) is not None:
            return True
        self.kill()
        self._process.wait()
        return False

    def kill(self) -> None:
        """Kill the process, also when it is stopped."""
        with contextlib.suppress(ProcessLookupError):
            os.kill(self._process.pid, signal.SIGCONT)
        self._process.kill()


def _require_pipe(pipe: IO[bytes] | None) -> IO[bytes]:
    if pipe is None:
        raise RuntimeError("the process was started without this pipe")
    return pipe


def watch_standard_input() -> threading.Event:
    """Event that is set when standard input ends, that is, when the parent process closes it or dies."""
    ended = threading.Event()

    def wait_for_end() -> None:
        # Not through sys.stdin: a thread that holds its lock aborts the interpreter at exit.
        while os.read(0, 4096):
            pass
        ended.set()

    BackgroundThread("standard input", wait_for_end).start()
    return ended


class Backoff:
    """Delays between restarts of a process: 1, 2, 4 ... 60 s, and 1 s again after it ran for 60 s."""

    _INITIAL_S, _MAX_S, _RESET_AFTER_S = 1.0, 60.0, 60.0

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._started, self._delay_s = clock(), self._INITIAL_S

    def mark_alive(self) -> None:
        """Note that the process runs; call it regularly."""
        if self._clock() - self._started >= self._RESET_AFTER_S:
            self._delay_s = self._INITIAL_S

    def is_over(self) -> bool:
        """Whether the process may be started again."""
        return self._clock() - self._started >= self._delay_s

    def begin_attempt(self) -> float:
        """Note a start; returns the least number of seconds until the next one."""
        self._started, self._delay_s = self._clock(), min(2 * self._delay_s, self._MAX_S)
        return self._delay_s


# ---------------------------------------------------------------- threads
class BackgroundThread(threading.Thread):
    """A daemon thread that logs and reports an unexpected exception instead of ending silently.

    ``work`` is called once, or every ``period_s`` seconds until :meth:`stop`. ``on_failure`` is called with
    the exception that ended it, in this thread.
    """

    def __init__(
        self,
        name: str,
        work: Callable[[], object],
        period_s: float | None = None,
        on_failure: Callable[[Exception], object] = lambda error: None,
    ) -> None:
        super().__init__(name=name, daemon=True)
        self._work, self._period_s, self._on_failure = work, period_s, on_failure
        self._stopping = threading.Event()

    def run(self) -> None:
        """Do the work; called by :meth:`threading.Thread.start`."""
        try:
            if self._period_s is None:
                self._work()
                return
            while not self._stopping.wait(self._period_s):
                self._work()
        except Exception as error:
            log.exception("the thread '%s' failed", self.name)
            self._on_failure(error)

    def stop(self, timeout_s: float = 5.0) -> None:
        """End the periodic calls and wait for the thread."""
        self._stopping.set()
        if self.is_alive() and threading.current_thread() is not self:
            self.join(timeout_s)
