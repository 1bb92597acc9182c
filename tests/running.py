"""A running ``escape`` process: its output, its end, and its use of resources."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from preloaded import End, Preloaded

ESCAPE = (sys.executable, "-c", "from escape_hw.cli import main; main()")
#: A user without rights.
NOBODY = 65534


def words_of_other_user() -> tuple[str, ...] | None:
    """Words that run a command without privileges, none if there are none now; ``None``: impossible."""
    if os.getuid() != 0:
        return ()
    words = ("setpriv", f"--reuid={NOBODY}", f"--regid={NOBODY}", "--clear-groups")
    probe = [*words, sys.executable, "-c", "import escape_hw.cli, escape_sim, escape_drivers"]
    possible = shutil.which("setpriv") and not subprocess.run(probe, capture_output=True, cwd="/").returncode
    return words if possible else None


@dataclass
class Ended:
    """How a process ended after it got its signals."""

    code: int
    wall_s: float
    cpu_s: float
    document: dict[str, Any]
    lines: list[str]


class Running:
    """A command under way, read line by line; ``fresh`` starts a Python for it."""

    def __init__(self, words: Sequence[object], environment: dict[str, str], *, fresh: bool = False) -> None:
        told = [str(word) for word in words]
        (out, out_end), (err, err_end) = os.pipe(), os.pipe()
        self._process: Preloaded | subprocess.Popen[bytes]
        if fresh:
            self._process = subprocess.Popen(
                [*ESCAPE, *told], stdout=out_end, stderr=err_end, env=environment
            )
        else:
            with open(os.devnull) as none:
                self._process = Preloaded(told, (none.fileno(), out_end, err_end), environment)
        os.close(out_end)
        os.close(err_end)
        self._stdout, self._stderr = os.fdopen(out, encoding="utf-8"), os.fdopen(err, encoding="utf-8")
        self._end: End | None = None
        self.lines: list[str] = []
        self._arrived = threading.Condition()
        self._ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        for line in self._stderr:
            with self._arrived:
                self.lines.append(line.rstrip())
                self._arrived.notify_all()
        with self._arrived:
            self._ended = True
            self._arrived.notify_all()

    def wait_for(self, beginning: str, timeout_s: float = 90.0) -> None:
        """Wait until a line begins like this."""
        with self._arrived:
            self._arrived.wait_for(lambda: self._ended or self._has(beginning), timeout_s)
            assert self._has(beginning), "\n".join(self.lines)

    def _has(self, beginning: str) -> bool:
        return any(line.startswith(beginning) for line in self.lines)

    def let_work(self, seconds: float) -> None:
        """Let it use so much processor time, however busy the machine is; not for ever, for it may wait."""
        enough, deadline = self._cpu_s() + seconds, time.monotonic() + 10 * seconds
        while self._cpu_s() < enough and time.monotonic() < deadline:
            time.sleep(0.02)

    def stop(self, *signals: int, pause_s: float = 0.05) -> Ended:
        """Send signals, wait for the end."""
        before, began = self._cpu_s(), time.monotonic()
        for number, which in enumerate(signals):
            if number:
                time.sleep(pause_s)
            # Not reaped before the end, so the number is still ours.
            os.kill(self._process.pid, which)
        out = self._stdout.read()
        end = self._wait()
        wall = time.monotonic() - began
        document = json.loads(out) if out.strip() else {}
        return Ended(end.code, wall, end.cpu_s - before, document, self.lines)

    def kill(self) -> None:
        """End it, if it has not ended."""
        if self._end is None:
            self._process.send_signal(signal.SIGKILL)
            self._wait()

    def _wait(self) -> End:
        """Wait for the end."""
        if isinstance(self._process, Preloaded):
            self._end = self._process.wait()
        else:
            _, status, usage = os.wait4(self._process.pid, 0)
            self._process.returncode = os.waitstatus_to_exitcode(status)
            self._end = End(self._process.returncode, usage.ru_utime + usage.ru_stime)
        self._reader.join(5)
        self._stdout.close()
        self._stderr.close()
        return self._end

    def _cpu_s(self) -> float:
        """Processor time that the process has used so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
