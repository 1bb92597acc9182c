"""A running ``escape`` process: its output, its end, and its use of resources."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ESCAPE = (sys.executable, "-c", "from escape_hw.cli import main; main()")


@dataclass
class Ended:
    """How a process ended after it got its signals."""

    code: int
    wall_s: float
    cpu_s: float
    document: dict[str, Any]
    lines: list[str]


class Running:
    """A command under way, read line by line."""

    def __init__(self, words: Sequence[object], environment: dict[str, str]) -> None:
        self._process = subprocess.Popen(
            [*ESCAPE, *map(str, words)],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self.lines: list[str] = []
        self._arrived = threading.Condition()
        self._ended = False
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    def _read(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
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
        assert self._process.stdout is not None
        out = self._process.stdout.read()
        self._process.stdout.close()
        _, status, usage = os.wait4(self._process.pid, 0)
        wall = time.monotonic() - began
        self._process.returncode = os.waitstatus_to_exitcode(status)
        self._reader.join(5)
        assert self._process.stderr is not None
        self._process.stderr.close()
        return Ended(
            self._process.returncode,
            wall,
            usage.ru_utime + usage.ru_stime - before,
            json.loads(out) if out.strip() else {},
            self.lines,
        )

    def kill(self) -> None:
        """End it, if it has not ended."""
        if self._process.returncode is None:
            self._process.kill()
            self._process.communicate()

    def _cpu_s(self) -> float:
        """Processor time that the process has used so far."""
        fields = Path(f"/proc/{self._process.pid}/stat").read_text().rpartition(")")[2].split()
        return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
