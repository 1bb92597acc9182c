"""Limits of a served bench with its real drivers: loop open, mirror flat, fault latched, cleared."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from serving import Spy, serving, until_idle, wait_for
from stand_in_bench import REGION, simulated_bench

from escape_hw.errors import RequestRefused
from escape_hw.remote.client import Connection
from escape_hw.remote.state import Finish, Phase
from escape_sim.stand_ins import bench_server
from escape_sim.stand_ins.bench_server import StandInBenchServer

#: Short enough for a test, and long enough for a machine whose processors all have other work; the loop's own
#: patience with a camera ends after five seconds.
LIMITS = {
    "lease_s": 15, "unattended_s": 1, "no_frames_s": 2.5, "diverging_factor": 2, "diverging_s": 0.4,
    "engine_silence_s": 60,
}  # fmt: skip


@pytest.fixture(scope="module")
def mirror() -> Iterator[tuple[StandInBenchServer, Spy]]:
    """The simulated bench, in this process, and what its mirror really does."""
    yield from simulated_bench(REGION)


@pytest.fixture(scope="module")
def held(
    system: Path, mirror: tuple[StandInBenchServer, Spy], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[tuple[Connection, Connection, str]]:
    """Who may write, who looks on, and the name of a matrix."""
    words = ["--set", REGION]
    for name, value in LIMITS.items():
        words += ["--set", f"server.{name}={value}"]
    folder = tmp_path_factory.mktemp("served")
    with (
        serving(system, "--mode", "hardware", *words, folder=folder, more=mirror[0].environment) as served,
        served.connect() as watcher,
    ):
        bench = served.connect(control=True)
        until_idle(bench)
        run = bench.start("docrime", frames=500)
        run.wait(120)
        yield bench, watcher, f"docrime-{run.id}"
        bench.close()


@pytest.fixture
def closed(held: tuple[Connection, Connection, str]) -> Connection:
    """The loop, closed and converged."""
    bench, _, matrix = held
    idle(bench)
    bench.close_loop(matrix, gain=0.4, leak=0.0)
    wait_for(lambda: bench.state.loop.closed and bench.state.mirror.peak > 0, "a shape on the mirror")
    return bench


def idle(bench: Connection) -> None:
    """Ready and ours, whatever the test before did."""
    bench.acquire(take_over=True)
    if bench.state.fault is not None:
        bench.clear_fault()
    until_idle(bench)


def made_safe(bench: Connection, spy: Spy, *words: str) -> None:
    """The fault, what it did, that nothing starts before it is cleared, and that everything does after it."""
    wait_for(lambda: bench.state.fault is not None, "the fault")
    wait_for(lambda: bench.state.phase is Phase.FAULT and not bench.state.loop.closed, "the loop is open")
    wait_for(lambda: bench.state.mirror.peak == 0.0, "the mirror is flat")
    assert spy.flat
    fault = bench.state.fault
    assert fault is not None
    assert any(word in fault.reason for word in words), fault.reason
    assert fault.remedy
    wait_for(lambda: any("FAULT" in line.text for line in bench.log_after(-1)), "a line in the log")
    with pytest.raises(RequestRefused, match="clear the fault first"):
        bench.start("docrime", frames=500)
    with pytest.raises(RequestRefused, match="clear the fault first"):
        bench.close_loop("docrime-1")
    bench.clear_fault()
    until_idle(bench)
    assert bench.state.fault is None


@pytest.mark.slow
def test_a_matrix_of_stand_ins_serves_every_procedure_there(held) -> None:
    bench, _, matrix = held
    idle(bench)
    run = bench.start("loop", im=matrix, frames=60, strehl=False).wait(120)
    assert run.frames == 60


def late(camera: object, wait_s: float) -> tuple[int, bytes]:
    """A camera whose frames do not come."""
    time.sleep(min(0.05, wait_s))
    return bench_server._TIMEOUT, b""


def test_no_frames(closed, mirror, monkeypatch) -> None:
    # The first frames of a loop may take longer: its functions are compiled.
    first = closed.state.rates.frames
    wait_for(lambda: closed.state.rates.frames > first + 200, "the loop's first frames")
    with monkeypatch.context() as patch:
        patch.setattr(bench_server._CameraEndpoint, "_frame", late)
        wait_for(lambda: closed.state.fault is not None, "the fault")
    made_safe(closed, mirror[1], "in closed loop (limit 2.5 s)")


def test_saturated_actuators(closed, mirror) -> None:
    closed.set_loop(gain=2.0)
    made_safe(closed, mirror[1], "at their limits", "the residual grew")


def shaken(camera: Any, wait_s: float) -> tuple[int, bytes]:
    """A camera that shakes by two pixels from frame to frame, too fast for any loop."""
    frame = camera._camera.next_frame(max(wait_s, 1e-3))
    image = np.roll(frame.data, 2 if frame.index % 2 else -2, axis=1)
    return bench_server._OK, bench_server._FRAME_HEAD.pack(frame.index, frame.exposed_ns) + image.tobytes()


@pytest.mark.slow
def test_a_diverging_residual(closed, mirror, monkeypatch) -> None:
    # The residual's usual size has to be known first, by its state five times a second.
    seen = {closed.state.serial}
    wait_for(lambda: len(seen) > 40 or seen.add(closed.state.serial), "states")
    with monkeypatch.context() as patch:
        patch.setattr(bench_server._CameraEndpoint, "_frame", shaken)
        wait_for(lambda: closed.state.fault is not None, "the fault")
    made_safe(closed, mirror[1], "the residual grew")


@pytest.mark.slow
def test_a_poke_run_that_lost_its_lease(held, mirror) -> None:
    bench, watcher, _ = held
    idle(bench)
    bench.start("docrime", frames=10_000_000)
    wait_for(lambda: watcher.state.mirror.peak > 0 and not mirror[1].flat, "pokes")
    bench.release()
    wait_for(lambda: watcher.state.fault is not None, "the fault")
    wait_for(
        lambda: watcher.state.last_run is not None and watcher.state.last_run.name == "docrime", "its end"
    )
    watcher.acquire()
    made_safe(watcher, mirror[1], "was without a client in control for")
    assert watcher.state.last_run.finish is Finish.ABORTED
    watcher.release()
