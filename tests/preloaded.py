"""Processes of ``escape`` that start at once: forked from a Python that has imported the package already.

Each has its own number, streams, folder and environment, gets signals and ends as any other. What takes most
of the time of a short command is left out: imports are done once per worker, and the figures of reports are
empty (other tests draw them). Tests of the start of Python itself use :data:`running.ESCAPE`.
"""

from __future__ import annotations

import atexit
import contextlib
import gc
import importlib
import json
import os
import runpy
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

#: What the commands of calibrations and loops import, numerical libraries first.
MODULES = (
    "numba", "scipy.optimize", "scipy.ndimage", "scipy.signal", "astropy.io.fits", "astropy.table",
    "matplotlib.figure", "matplotlib.backends.backend_svg", "matplotlib.backends.backend_agg",
    "escape_hw.cli.app", "escape_hw.runtime.procedures.calibration", "escape_hw.runtime.procedures.products",
    "escape_hw.runtime.session.system", "escape_hw.report.run_report", "escape_sim.devices.twins",
)  # fmt: skip
_SIGNALS = (signal.SIGHUP, signal.SIGINT, signal.SIGQUIT, signal.SIGTERM)


class End(NamedTuple):
    """How a process ended."""

    code: int
    cpu_s: float


class Preloaded:
    """A process: ``escape`` with these words, or a program if they begin with ``-c`` or a file of Python.

    Parameters
    ----------
    words
        What follows the name of the program.
    streams
        Descriptors of its standard input, output and error.
    environment, folder
        Those of the process; by default of this one.
    """

    def __init__(
        self,
        words: Sequence[str],
        streams: tuple[int, int, int],
        environment: Mapping[str, str] | None = None,
        folder: Path | None = None,
    ) -> None:
        self._reply, theirs = socket.socketpair()
        order = {
            "words": words,
            "environment": dict(os.environ if environment is None else environment),
            "folder": os.fspath(folder or Path.cwd()),
            "ignored": [number for number in _SIGNALS if signal.getsignal(number) is signal.SIG_IGN],
        }
        with theirs:
            socket.send_fds(_parent(), [json.dumps(order).encode()], [*streams, theirs.fileno()])
        self._lines = self._reply.makefile("r")
        self.pid = int(self._lines.readline())
        self._end: End | None = None

    def wait(self, timeout_s: float | None = None) -> End:
        """Its end; raises :class:`TimeoutError` if it does not come."""
        if self._end is None:
            self._reply.settimeout(timeout_s)
            self._lines.readline()
            # Until now its number was its own, as that of a child.
            self._reply.send(b"end")
            code, cpu_s = self._lines.readline().split()
            self._end = End(int(code), float(cpu_s))
            self.close()
        return self._end

    def close(self) -> None:
        """Hear no more of it."""
        self._lines.close()
        self._reply.close()

    def send_signal(self, number: int) -> None:
        """Send it a signal, unless its end is known."""
        if self._end is None:
            os.kill(self.pid, number)


def run(
    words: Sequence[str],
    environment: Mapping[str, str] | None = None,
    folder: Path | None = None,
    timeout_s: float = 240.0,
) -> subprocess.CompletedProcess[str]:
    """Run a process to its end."""
    with tempfile.TemporaryFile() as out, tempfile.TemporaryFile() as err, open(os.devnull) as none:
        started = Preloaded(words, (none.fileno(), out.fileno(), err.fileno()), environment, folder)
        try:
            ended = started.wait(timeout_s)
        except TimeoutError:
            started.send_signal(signal.SIGKILL)
            started.close()
            raise
        texts = []
        for file in (out, err):
            file.seek(0)
            texts.append(file.read().decode("utf-8", "replace"))
    return subprocess.CompletedProcess(list(words), ended.code, *texts)


_parents: dict[int, socket.socket] = {}


def _parent() -> socket.socket:
    """Where orders go: to the Python from which processes are forked, and which ends with this one."""
    if os.getpid() not in _parents:
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        code = "import sys; sys.path.insert(0, sys.argv[1]); import preloaded; preloaded.serve(sys.argv[2])()"
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-c", code, str(Path(__file__).parent), str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                # A process with threads must not be forked.
                env={**os.environ, **{f"{name}_NUM_THREADS": "1" for name in ("OPENBLAS", "OMP", "NUMBA")}},
            )
        _parents[os.getpid()] = ours
        atexit.register(process.wait, 30)
        atexit.register(ours.close)
    return _parents[os.getpid()]


def serve(descriptor: str) -> Callable[[], None]:
    """Fork a process for every order; returns in each of them, with what it is to do."""
    for module in MODULES:
        importlib.import_module(module)
    _load_compiled_code()
    gc.collect()
    gc.freeze()
    del sys.path[0]
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    with socket.socket(fileno=int(descriptor)) as orders:
        while True:
            order, files, *_ = socket.recv_fds(orders, 1 << 20, 4)
            if not order:
                raise SystemExit
            if os.fork() == 0:
                break
            for file in files:
                os.close(file)
            while _ended_child():
                pass
    # One process waits for the end of the other and reports it.
    *streams, reply = files
    pid = os.fork()
    if pid == 0:
        os.close(reply)
        return _become(json.loads(order), streams)
    for file in streams:
        os.close(file)
    # Who asked may have ended.
    with contextlib.suppress(OSError):
        os.write(reply, f"{pid}\n".encode())
        os.waitid(os.P_PID, pid, os.WEXITED | os.WNOWAIT)
        os.write(reply, b"ended\n")
        os.read(reply, 3)
    _, status, usage = os.wait4(pid, 0)
    with contextlib.suppress(OSError):
        os.write(reply, f"{os.waitstatus_to_exitcode(status)} {usage.ru_utime + usage.ru_stime}\n".encode())
    os._exit(0)


def _ended_child() -> int:
    """Number of a child that has ended; 0 for none."""
    try:
        return os.waitpid(-1, os.WNOHANG)[0]
    except ChildProcessError:
        return 0


def _load_compiled_code() -> None:
    """Load what is compiled at its first use, with a short calibration; reports have no drawings."""
    from small_system import configuration

    from escape_hw.report.figures import style
    from escape_hw.runtime.session.system import System

    style.svg = lambda figure, key: "<svg></svg>"
    with System.from_config(configuration()) as bench:
        bench.calibrate("docrime", frames=100)


def _become(order: dict[str, Any], streams: Sequence[int]) -> Callable[[], None]:
    """Take on what a new process gets, as Python does at its start."""
    os.chdir(order["folder"])
    os.environ.clear()
    os.environ.update(order["environment"])
    for number in _SIGNALS:
        usual = signal.default_int_handler if number == signal.SIGINT else signal.SIG_DFL
        signal.signal(number, signal.SIG_IGN if number in order["ignored"] else usual)
    for target, stream in enumerate(streams):
        os.dup2(stream, target)
        os.close(stream)
    stdin, stdout = (os.fdopen(n, mode, encoding="utf-8", closefd=False) for n, mode in enumerate("rw"))
    stderr = os.fdopen(2, "w", 1, encoding="utf-8", errors="backslashreplace", closefd=False)
    vars(sys).update(stdin=stdin, stdout=stdout, stderr=stderr)
    vars(sys).update(__stdin__=stdin, __stdout__=stdout, __stderr__=stderr)
    words = list(order["words"])
    if words[0] == "-c":
        sys.argv = ["-c", *words[2:]]
        code = compile(words[1], "<string>", "exec", dont_inherit=True)
        return lambda: exec(code, vars(sys.modules["__main__"]))
    if words[0].endswith(".py"):
        sys.argv, sys.path[0] = words, str(Path(words[0]).parent)
        return lambda: runpy.run_path(words[0], run_name="__main__") and None
    from escape_hw.cli import main

    sys.argv = ["-c", *words]
    return main
