"""Effect of a window on the loop: latency with the window running and with it halted, alternately.

A server of ``razor-shwfs`` on the twin, which loses no frames here, closes its loop on a short DO-CRIME.
A window connected to it is halted and resumed every few seconds, so that other load of the machine affects
both equally. Prints the ratios of the medians over all turns, and the 16th and 84th percentile of a bootstrap
over pairs of turns: where 1 lies between them, the effect of the window is within the noise.
``python benchmarks/studies/speed/gui_and_loop_latency.py [TURNS]``.
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
from numpy.typing import NDArray

sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "tests"))
sys.path.insert(0, str(Path(__file__).resolve().parents[3] / "tests" / "process"))

from serving import SYSTEM, Served, serving, until_idle, wait_for

from escape_hw.remote.client import Connection

TURNS, TURN_S, SETTLE_S = 10, 4.0, 1.5
DRAWS = 2000


def start_window(served: Served) -> subprocess.Popen[bytes]:
    environment = {**served.environment, "QT_QPA_PLATFORM": "offscreen"}
    words = ["-c", "from escape_hw.cli import main; main()", "gui", "--connect", SYSTEM, "--reset-settings"]
    return subprocess.Popen([sys.executable, *words], env=environment, stderr=subprocess.DEVNULL)


def latencies(bench: Connection) -> NDArray[np.float64]:
    """Median and 99th percentile, microseconds; means over the seconds of a turn."""
    time.sleep(SETTLE_S)
    found = []
    for _ in range(round(TURN_S)):
        latency = bench.state.latency
        found.append((latency.p50, latency.p99))
        time.sleep(1.0)
    return np.asarray(np.exp(np.mean(np.log(found), axis=0)))


def ratios(seen: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Ratios of medians over the turns, and the bootstrap's 16th and 84th percentiles of them.

    ``seen`` holds (turn, with or without, median or p99).
    """
    drawn = np.random.default_rng(1).integers(len(seen), size=(DRAWS, len(seen)))
    medians = np.median(seen[drawn], axis=1)
    medians_over_turns = np.median(seen, axis=0)
    return medians_over_turns[0] / medians_over_turns[1], np.percentile(
        medians[:, 0] / medians[:, 1], [16, 84], axis=0
    )


def main() -> None:
    turns = int(sys.argv[1]) if sys.argv[1:] else TURNS
    with (
        tempfile.TemporaryDirectory() as folder,
        serving("razor-shwfs", "--set", "twin.loss_probability=0", folder=Path(folder)) as served,
    ):
        bench = served.connect(control=True)
        until_idle(bench)
        bench.calibrate("docrime", frames=1000)
        bench.close_loop(bench.state.products[-1].name)
        wait_for(lambda: bench.state.loop.closed, "the loop is closed")
        shown = start_window(served)
        wait_for(lambda: bench.state.clients > 1, "the window is attached")
        seen = []
        for number in range(turns):
            # Each is the first of its pair as often as the second.
            order = ("with", "without") if number % 2 else ("without", "with")
            pair = {}
            for which in order:
                os.kill(shown.pid, signal.SIGCONT if which == "with" else signal.SIGSTOP)
                pair[which] = latencies(bench)
            seen.append((pair["with"], pair["without"]))
            words = ", ".join(f"{name} {p50:.0f} / {p99:.0f} us" for name, (p50, p99) in pair.items())
            print(f"turn {number + 1}: {words}", flush=True)
        lost, frames = bench.state.rates.lost_frames, bench.state.rates.frames
        shown.kill()
        shown.wait()
        bench.open_loop()
        bench.close()
    found = np.array(seen)
    ratio, (low, high) = ratios(found)
    for k, name in enumerate(("median", "p99")):
        ours, alone = np.median(found[:, :, k], axis=0)
        noise = "within noise" if low[k] <= 1 <= high[k] else "beyond noise"
        print(
            f"{name:<7} with window {ours:8.0f} us   without {alone:8.0f} us   "
            f"ratio {ratio[k]:.3f} ({low[k]:.3f} to {high[k]:.3f}), {noise}"
        )
    print(f"frames lost {lost} of about {frames}")


if __name__ == "__main__":
    main()
