"""Supervises the front-end process: start, restart after its death, and end."""

from __future__ import annotations

import contextlib
import ctypes
import json
import logging
import os
import subprocess
import time
from pathlib import Path
from typing import Any, Self

from escape_hw.api.procedure import StopSignal
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError, EscapeError
from escape_hw.remote.address import (
    ServerListing,
    find_server,
    local_endpoint,
    register_server,
    tcp_endpoint,
    unregister_server,
)
from escape_hw.remote.requests import error_from_document
from escape_hw.server.frontend.engine_process import STOP_TIMEOUT_S
from escape_hw.server.frontend.main import FrontEndSetup
from escape_hw.supervision import Backoff, ChildProcess, process_start

log = logging.getLogger(__name__)

_FRONT_END = "escape_hw.server.frontend.main"
#: Seconds that a front end may take to end: its engine ends before, and its fail-safe process after that.
_STOP_TIMEOUT_S = 2 * STOP_TIMEOUT_S + 10.0
_POLL_S = 0.05
#: ``prctl`` option: orphaned descendants become children of this process.
_PR_SET_CHILD_SUBREAPER = 36


class FrontEndSupervisor:
    """A front end that is started again when it dies; a context manager.

    The engine of a dead front end flattens the mirror and ends; the next front end starts after that, with an
    engine of its own and the same addresses, so that clients reconnect. It ends when the supervisor dies.

    Attributes
    ----------
    listing
        Entry of the server in the user's list while it is entered, also while a front end is restarted.

    Raises
    ------
    ConfigError
        The system is served already, or the address is not available.
    """

    def __init__(
        self, config: SystemConfig, host: str, port: int | None, runs: Path, read_folders: tuple[Path, ...]
    ) -> None:
        name, pid = config.system.name, os.getpid()
        running = find_server(name)
        if running is not None and running.alive:
            raise ConfigError(f"'{name}' is already served by process {running.pid}; stop that server first")
        if running is not None:
            unregister_server(running)
        local = local_endpoint(name, pid)
        tcp = "" if port is None else tcp_endpoint(host, port).requests
        self.listing = ServerListing(name, pid, process_start(pid) or 0, local.requests, local.events, tcp)
        self._setup = FrontEndSetup(
            config_text=config.to_toml(), local=local, host=host, port=port, runs=runs,
            read_folders=read_folders, server_pid=pid, first_number=_first_number(),
        )  # fmt: skip
        self._process: ChildProcess | None = None
        #: Child processes that this process has for other purposes.
        self._others: frozenset[int] = frozenset()

    def __enter__(self) -> Self:
        """Start the front end."""
        # Makes it possible to wait for the engine of a dead front end.
        ctypes.CDLL(None, use_errno=True).prctl(_PR_SET_CHILD_SUBREAPER, 1, 0, 0, 0)
        self._others = _children()
        try:
            self._start()
            register_server(self.listing)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        self._stop()
        unregister_server(self.listing)

    def run(self, stop: StopSignal) -> None:
        """Keep a front end running until ``stop`` is set or a client ends the server.

        EscapeError: the front end died while it was stopped; its engine has made the mirror flat.
        """
        backoff = Backoff()
        while True:
            if self._process is not None:
                code = self._wait(self._process, stop, backoff)
                if code == 0:
                    return
                self._clean_up(self._process, code)
            if stop.is_set():
                raise EscapeError("the front end died while the server was stopped; look at the log")
            if backoff.is_over():
                self._restart(backoff)
            else:
                time.sleep(_POLL_S)

    def _wait(self, process: ChildProcess, stop: StopSignal, backoff: Backoff) -> int:
        """Wait for the end of the front end, requested when ``stop`` is set; returns its exit code."""
        while (code := process.wait(_POLL_S)) is None:
            backoff.mark_alive()
            if stop.is_set():
                _request_stop(process)
        return code

    def _clean_up(self, process: ChildProcess, code: int) -> None:
        """Wait for the end of the processes of a front end that died."""
        log.error("the front end (process %d) died with code %s", process.pid, code)
        self._process = None
        self._setup = self._setup.model_copy(update={"first_number": _first_number()})
        _reap_orphans(self._others)

    def _restart(self, backoff: Backoff) -> None:
        pause_s = backoff.begin_attempt()
        log.error("the front end is restarted, and not again within %g s", pause_s)
        try:
            self._start()
        except (EscapeError, OSError) as error:
            log.error("the front end cannot be started; next attempt in %g s: %s", pause_s, error)
            self._stop()

    def _start(self) -> None:
        """Start a front end and wait until it listens."""
        process = self._process = ChildProcess(_FRONT_END, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        with contextlib.suppress(BrokenPipeError):
            process.stdin.write(self._setup.model_dump_json().encode() + b"\n")
            process.stdin.flush()
        with process.stdout as output:
            line = output.readline()
        if not line:
            raise EscapeError(f"the front end ended at its start, with code {process.wait(_STOP_TIMEOUT_S)}")
        message: dict[str, Any] = json.loads(line)
        if "error" in message:
            raise error_from_document(message["error"])

    def _stop(self) -> None:
        """End the front end and wait for its processes."""
        process, self._process = self._process, None
        if process is not None:
            _request_stop(process)
            if not process.wait_or_kill(_STOP_TIMEOUT_S):
                log.error("the front end did not end within %g s and was killed", _STOP_TIMEOUT_S)
            _reap_orphans(self._others)


def _first_number() -> int:
    """Number of the first log line and state of a front end, microseconds since 1970.

    Clients keep the numbers of what they have: those of a later front end or server must be larger.
    """
    return int(1e6 * time.time())


def _request_stop(process: ChildProcess) -> None:
    """Ask a front end to end: its standard input ends."""
    with contextlib.suppress(OSError):
        process.stdin.close()


def _children() -> frozenset[int]:
    """Processes whose parent is this process."""
    own, found = str(os.getpid()), set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError):
                # State and parent follow the name, which may contain anything.
                if (entry / "stat").read_text().rpartition(")")[2].split()[1] == own:
                    found.add(int(entry.name))
    return frozenset(found)


def _reap_orphans(others: frozenset[int]) -> None:
    """Wait until engine, fail-safe process and recorder of a dead front end ended; not for ``others``."""
    deadline = time.monotonic() + _STOP_TIMEOUT_S
    while (left := _children() - others) and time.monotonic() < deadline:
        ended = False
        for pid in left:
            with contextlib.suppress(ChildProcessError):
                ended |= os.waitpid(pid, os.WNOHANG) != (0, 0)
        if not ended:
            time.sleep(_POLL_S)
