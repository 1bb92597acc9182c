"""What a window does to the loop beside it: latency with the window alive and with it stopped, in turn.

A server of ``razor-shwfs`` on the twin closes its loop on a short DO-CRIME. A window on it is halted and let
go every few seconds, so that whatever else the machine does falls on both alike:
``python benchmarks/gui_beside_loop.py``.
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "process"))

from serving import SYSTEM, Served, serving, until_idle, wait_for

from escape_hw.remote.client import Connection

TURNS, TURN_S, SETTLE_S = 6, 4.0, 1.5


def window(served: Served) -> subprocess.Popen[bytes]:
    environment = {**served.environment, "QT_QPA_PLATFORM": "offscreen"}
    words = ["-c", "from escape_hw.cli import main; main()", "gui", "--connect", SYSTEM, "--reset-settings"]
    return subprocess.Popen([sys.executable, *words], env=environment, stderr=subprocess.DEVNULL)


def latencies(bench: Connection, seconds: float) -> list[tuple[float, float]]:
    """Median and 99th percentile of each second, microseconds."""
    time.sleep(SETTLE_S)
    found = []
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        latency = bench.state.latency
        found.append((latency.p50, latency.p99))
        time.sleep(1.0)
    return found


def main() -> None:
    with tempfile.TemporaryDirectory() as folder, serving("razor-shwfs", folder=Path(folder)) as served:
        bench = served.connect(control=True)
        until_idle(bench)
        bench.calibrate("docrime", frames=1000)
        bench.close_loop(bench.state.products[-1].name)
        wait_for(lambda: bench.state.loop.closed, "the loop is closed")
        shown = window(served)
        wait_for(lambda: bench.state.clients > 1, "the window is attached")
        seen: dict[str, list[tuple[float, float]]] = {"with": [], "without": []}
        for _ in range(TURNS):
            os.kill(shown.pid, signal.SIGCONT)
            seen["with"] += latencies(bench, TURN_S)
            os.kill(shown.pid, signal.SIGSTOP)
            seen["without"] += latencies(bench, TURN_S)
        shown.kill()
        shown.wait()
        bench.open_loop()
        bench.close()
    medians = {name: np.median(np.array(values), axis=0) for name, values in seen.items()}
    for k, name in enumerate(("median", "p99")):
        ours, alone = (medians[which][k] for which in ("with", "without"))
        print(f"{name:<7} with window {ours:8.0f} us   without {alone:8.0f} us   ratio {ours / alone:.2f}")
    print(f"frames lost {bench.state.rates.lost}")


if __name__ == "__main__":
    main()
