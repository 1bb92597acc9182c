"""A window that is killed or hangs does not disturb the closed loop; the next window finds the server."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest
from serving import SYSTEM, Served, serving, until_idle, wait_for
from small_system import configuration

from escape_hw.remote.client import Connection
from escape_hw.remote.state import Phase

#: Time limit for a window to start on a busy computer, seconds.
ATTACH_S = 60.0


def window(served: Served) -> subprocess.Popen[bytes]:
    """``escape gui`` on the server, without a screen."""
    code = "from escape_hw.cli import main; main()"
    environment = {
        **served.environment, "QT_QPA_PLATFORM": "offscreen", "XDG_CONFIG_HOME": str(served.folder),
    }  # fmt: skip
    words = [sys.executable, "-c", code, "gui", "--connect", SYSTEM]
    return subprocess.Popen(words, env=environment, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def closed_loop(bench: Connection) -> None:
    """Calibrate a little and close the loop."""
    bench.calibrate("docrime", frames=600)
    matrix = bench.state.products[-1].name
    bench.close_loop(matrix, gain=0.3)
    wait_for(lambda: bench.state.loop.closed and bench.state.phase is Phase.LOOP, "the loop is closed")


def advances(bench: Connection, frames: int) -> None:
    """The loop processes this number of further frames without a fault."""
    before = bench.state.rates.frames
    wait_for(lambda: bench.state.rates.frames > before + frames, "frames go on")
    assert bench.state.fault is None
    assert bench.state.loop.closed


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSTOP], ids=["killed", "stopped"])
def test_a_window_that_dies_does_not_disturb_the_loop(number: int, tmp_path: Path) -> None:
    small = tmp_path / "small.toml"
    small.write_text(configuration().to_toml())
    # A busy computer may stop the engine for longer than the usual limits.
    limits = ("--set", "server.engine_silence_s=60", "--set", "server.no_frames_s=60")
    with serving(small, *limits, folder=tmp_path) as served:
        bench = served.connect(control=True)
        windows: list[subprocess.Popen[bytes]] = []
        try:
            until_idle(bench)
            closed_loop(bench)
            alone = bench.state.clients
            windows.append(window(served))
            wait_for(lambda: bench.state.clients == alone + 1, "the window is attached", ATTACH_S)
            advances(bench, 200)
            os.kill(windows[0].pid, number)
            advances(bench, 500)
            windows.append(window(served))
            following = f"process {windows[1].pid})"
            wait_for(
                lambda: any(following in line.text for line in bench.log_after(-1)), "attached", ATTACH_S
            )
            advances(bench, 200)
            if number == signal.SIGSTOP:
                # A resumed window reconnects at once.
                wait_for(lambda: bench.state.clients == alone + 1, "nobody counts it any more")
                os.kill(windows[0].pid, signal.SIGCONT)
                wait_for(lambda: bench.state.clients == alone + 2, "it is heard again", ATTACH_S)
            bench.open_loop()
        finally:
            for one in windows:
                one.kill()
                one.wait()
            bench.close()
