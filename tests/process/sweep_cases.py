"""A small sweep as a command, to be killed and resumed."""

from __future__ import annotations

import json
import os
import signal
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path

from small_system import configuration

import escape_hw
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import System

ESCAPE = (sys.executable, "-c", "from escape_hw.cli import main; main()")
#: Short loops: a few tens of them run in some seconds.
SHORT = (
    "--trials", "12", "--candidates", "1", "--replicates", "1", "--final-replicates", "6", "--frames", "270",
    "--quiet", "--json",
)  # fmt: skip
#: 12 drawn, one replicate and six final ones of two matrices.
LOOPS = 12 + 2 + 12


def matrices(folder: Path) -> tuple[str, ...]:
    """System, matrices and options of the sweep, measured once."""
    config = configuration()
    (folder / "small.toml").write_text(config.to_toml())
    with System.from_config(config) as bench:
        for method, name in (("push-pull", "pp"), ("docrime", "dc")):
            frames = 500 if method == "docrime" else None
            found = bench.calibrate(method, frames=frames)
            escape_hw.save_matrix(folder / f"{name}.fits", found, BenchRecord.from_bench(bench).origin())
    ims = [str(folder / f"{name}.fits") for name in ("pp", "dc")]
    return (str(folder / "small.toml"), "--im", ims[0], "--im", ims[1], *SHORT)


def start(*arguments: str) -> subprocess.Popen[str]:
    """``escape sweep`` with these arguments."""
    return subprocess.Popen(
        [*ESCAPE, "sweep", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def ended(process: subprocess.Popen[str], timeout_s: float = 280.0) -> dict:
    """The document of a command that must succeed, or fail only its own criterion."""
    out, err = process.communicate(timeout=timeout_s)
    assert process.returncode in (0, 1), err
    return dict(json.loads(out))


def finished(database: Path) -> dict[int, str]:
    """Numbers of the finished trials in an SQLite study, with what they found."""
    if not database.is_file():
        return {}
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True, timeout=30)) as connection:
        try:
            rows = connection.execute(
                "select t.number, a.value_json from trials t join trial_user_attributes a using (trial_id) "
                "where t.state in ('COMPLETE', 'PRUNED') and a.key = 'outcome'"
            ).fetchall()
        except sqlite3.OperationalError:
            # The tables are being made.
            return {}
    return {int(number): str(text) for number, text in rows}


def states(database: Path) -> dict[str, int]:
    """Trials by state in an SQLite study."""
    with closing(sqlite3.connect(f"file:{database}?mode=ro", uri=True)) as connection:
        return dict(connection.execute("select state, count(*) from trials group by state").fetchall())


def until(
    ready: Callable[[], object], timeout_s: float = 200.0, process: subprocess.Popen[str] | None = None
) -> None:
    """Wait until something is so; a process that ends before it is has failed."""
    deadline = time.monotonic() + timeout_s
    while not ready():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < deadline, "it did not come so far"
        time.sleep(0.05)


def workers_of(pid: int) -> list[int]:
    """The worker processes that a sweep has spawned."""
    found = []
    for path in Path("/proc").glob("[0-9]*"):
        try:
            parent = int((path / "stat").read_text().rpartition(")")[2].split()[1])
            words = (path / "cmdline").read_bytes()
        except (OSError, IndexError, ValueError):
            continue
        if parent == pid and b"spawn_main" in words:
            found.append(int(path.name))
    return found


def kill(pid: int) -> None:
    """End a process that this test has started, at once."""
    os.kill(pid, signal.SIGKILL)
