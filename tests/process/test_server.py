"""A server on the twin, through the client: the same procedures and results as on the command line."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from serving import SYSTEM, Served, serving, until_idle, wait_for

from escape_hw.errors import (
    Aborted,
    CalibrationError,
    ConfigError,
    LeaseHeld,
    ProductError,
    RequestRefused,
    TooFewFrames,
)
from escape_hw.remote.client import Connection
from escape_hw.remote.state import DeviceHealth, Finish, Phase
from escape_hw.runtime.procedures.calibration import METHODS


@pytest.fixture(scope="module")
def served(system: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    with serving(system, "--set", "server.lease_s=1.5", folder=folder) as one:
        yield one


@pytest.fixture(scope="module")
def holder(served: Served) -> Iterator[Connection]:
    with served.connect(control=True) as one:
        until_idle(one)
        yield one


@pytest.fixture
def bench(holder: Connection) -> Iterator[Connection]:
    """The server, idle and with control, whatever the previous test did."""
    holder.acquire(take_over=True)
    yield holder
    holder.flatten()
    if holder.state.fault is not None:
        holder.clear_fault()
    until_idle(holder)


@pytest.fixture(scope="module")
def matrix(holder: Connection) -> str:
    """Name of a matrix that the server made. It is set up before ``bench``, whoever has control."""
    holder.acquire(take_over=True)
    run = holder.start("docrime", frames=1000)
    run.wait(120)
    return f"docrime-{run.id}"


def test_a_run_ends_with_the_result_and_the_folder_of_the_command_line(bench: Connection) -> None:
    run = bench.start("docrime", frames=600, poke=0.01)
    result = run.wait(120, progress=True)
    assert result.matrix.metrics["poke"] == 0.01
    assert result.frames == 600
    ended = run.ended
    assert ended is not None
    assert ended.finish is Finish.DONE
    folder = Path(ended.folder)
    assert {"im.fits", "report.html", "result.json", "config.toml", "run.log"} <= {
        p.name for p in folder.iterdir()
    }
    document = json.loads((folder / "result.json").read_text())
    assert document["frames"] == 600 == ended.document["frames"]
    assert bench.state.products[-1].name == f"docrime-{run.id}"


def test_state_devices_geometry_and_frames(bench: Connection, matrix: str) -> None:
    state = bench.state
    assert state.system == SYSTEM
    assert state.simulated
    assert [one.name for one in state.devices] == ["dm", "wfs", "science", "screen"]
    assert {one.health for one in state.devices} == {DeviceHealth.OK}
    first = bench.latest("frames")
    assert first is not None
    assert first.data.shape == (200, 200)
    assert first.meta["full_scale"] == 1023
    wait_for(lambda: bench.latest("frames", first.index) is not None, "another frame")
    geometry = bench.geometry()
    assert sum(row.count("1") for row in geometry.layout) == 37
    assert len(geometry.outlines_px) == sum(row.count("1") for row in geometry.valid) > 50
    slopes = bench.latest("slopes")
    assert slopes is not None
    assert slopes.data.shape == (2 * len(geometry.outlines_px),)
    # Until it has been idle for some frames, the pause since the last procedure is part of the rate.
    wait_for(lambda: bench.state.rates.frame_hz == pytest.approx(500, rel=0.01), "the camera's rate")


def test_while_it_measures_matrix_and_progress_are_shown(bench: Connection) -> None:
    run = bench.start("docrime", frames=10_000_000)
    wait_for(lambda: run.running is not None and run.running.total == 10_000_000, "progress")
    wait_for(lambda: bench.latest("matrix") is not None, "a matrix")
    running = bench.state.active_run
    assert running is not None
    assert (running.id, running.name) == (run.id, "docrime")
    assert bench.latest("matrix").data.shape[1] == 30
    wait_for(lambda: bench.state.mirror.peak > 0, "pokes")
    bench.abort()
    with pytest.raises(Aborted, match="the data measured so far are saved") as stop:
        run.wait(120)
    assert stop.value.partial.partial
    assert (stop.value.stopped_at["total"], stop.value.stopped_at["unit"]) == (10_000_000, "frame")
    wait_for(lambda: bench.state.mirror.peak == 0.0, "a flat mirror")


def test_the_loop_closes_takes_other_settings_and_opens(bench: Connection, matrix: str) -> None:
    bench.close_loop(matrix, gain=0.4)
    wait_for(lambda: bench.state.loop.closed and bench.state.loop.residual_nm > 0, "the loop is closed")
    assert bench.state.phase is Phase.LOOP
    assert bench.state.loop.matrix == matrix
    wait_for(lambda: bench.latest("residual_modes") is not None, "residual")
    assert bench.latest("residual_modes").data.shape == (30,)
    with pytest.warns(DeprecationWarning, match="residual_modes"):
        assert bench.latest("modes").data.shape == (30,)
    bench.set_loop(gain=0.25, dropped_modes=6)
    wait_for(lambda: bench.state.loop.gain == 0.25, "the gain")
    assert (bench.state.loop.dropped_modes, bench.state.loop.matrix) == (6, matrix)
    wait_for(lambda: bench.state.latency.p50 > 0, "latency")
    with pytest.raises(RequestRefused, match="the loop is closed; open it first"):
        bench.start("docrime")
    with pytest.raises(ConfigError, match="there is no matrix 'nothing'"):
        bench.set_loop(matrix="nothing")
    assert bench.state.phase is Phase.LOOP
    bench.open_loop()
    assert bench.state.mirror.peak == 0.0
    wait_for(lambda: bench.state.phase is Phase.IDLE, "idle")


def test_who_looks_after_asking_sees_what_was_done(bench: Connection, matrix: str) -> None:
    for number in range(5):
        gain = 0.2 + 0.01 * number
        bench.close_loop(matrix, gain=gain)
        assert (bench.state.loop.closed, bench.state.loop.gain, bench.state.phase) == (True, gain, Phase.LOOP)
        bench.set_loop(gain=gain + 0.1)
        assert bench.state.loop.gain == gain + 0.1
        bench.open_loop()
        assert (bench.state.loop.closed, bench.state.mirror.peak) == (False, 0.0)
        until_idle(bench)
    run = bench.start("docrime", frames=10_000_000)
    assert bench.state.active_run is not None
    assert (bench.state.active_run.id, bench.state.phase) == (run.id, Phase.PROCEDURE)
    bench.abort()


def test_a_closed_loop_is_closed_again_after_a_procedure_with_a_loop_of_its_own(
    bench: Connection, matrix: str
) -> None:
    bench.close_loop(matrix, gain=0.35, leak=0.001, dropped_modes=5)
    asked = {"im": matrix, "frames": 300, "gain": 0.2, "strehl": False}
    assert "closed again with the same parameters" in bench.plan("loop", asked).warnings[-1]
    assert "open the loop first" in bench.plan("docrime", {}).warnings[-1]
    result = bench.calibrate("loop", **asked)
    assert result.frames == 300
    wait_for(lambda: bench.state.loop.closed and bench.state.phase is Phase.LOOP, "the loop is closed again")
    loop = bench.state.loop
    assert (loop.matrix, loop.gain, loop.leak, loop.dropped_modes) == (matrix, 0.35, 0.001, 5)
    wait_for(lambda: bench.state.mirror.peak > 0, "a shape on the mirror")
    # Who stops it wants the mirror flat, and finds it so.
    run = bench.start("loop", **{**asked, "frames": 10_000_000})
    wait_for(lambda: bench.state.active_run is not None and bench.state.active_run.completed > 100, "frames")
    bench.abort()
    with pytest.raises(Aborted):
        run.wait(60)
    until_idle(bench)
    assert bench.state.mirror.peak == 0.0
    assert not bench.state.loop.closed


@pytest.mark.slow
def test_sprint_on_a_stored_matrix(bench: Connection, matrix: str) -> None:
    plan = bench.plan("sprint", {"im": matrix})
    assert (plan.frames, plan.stroke) == (0, 0.0)
    run = bench.start("sprint", im=matrix)
    result = run.wait(120)
    assert result.registration.converged
    shift = result.registration.parameters()["shift_x"]
    assert abs(shift.value + 16) < 5 * shift.sigma < 10
    # The model's matrix is the one to close the loop with.
    made = {one.name: one.summary for one in bench.state.products}
    assert made[f"sprint-{run.id}"].startswith("escape,")
    assert made[f"sprint-{run.id}-im"].startswith("docrime")


@pytest.mark.slow
def test_gains_and_the_matrix_that_they_scale_both_stay_in_the_store(bench: Connection, matrix: str) -> None:
    run = bench.start("gains", im=matrix, frames=300, accuracy=0.5, strehl=False)
    run.wait(120)
    kinds = {one.name: one.kind for one in bench.state.products}
    assert (kinds[f"gains-{run.id}"], kinds[f"gains-{run.id}-gains"]) == ("matrix", "gains")


def test_every_procedure_of_the_command_line_is_offered(bench: Connection) -> None:
    offered = {one.name for one in bench.procedures()}
    assert {*METHODS, "sprint", "loop", "gains", "track"} <= offered


def test_a_closed_loop_run_and_its_result(bench: Connection, matrix: str) -> None:
    result = bench.calibrate("loop", im=matrix, frames=300, strehl=False)
    assert result.frames == 300
    assert result.stable


@pytest.mark.slow
def test_a_halted_run_has_a_flat_mirror_and_continues(bench: Connection) -> None:
    run = bench.start("docrime", frames=4000)
    wait_for(lambda: bench.state.active_run is not None and bench.state.active_run.completed > 300, "frames")
    bench.pause()
    wait_for(lambda: bench.state.active_run is not None and bench.state.active_run.paused, "halted")
    wait_for(lambda: bench.state.mirror.peak == 0.0, "a flat mirror")
    done = bench.state.active_run.completed
    bench.resume()
    result = run.wait(120)
    assert done < 4000 == result.frames
    assert float(np.median(result.matrix.snr())) > 5


def test_a_check_gives_frames_time_and_stroke_and_moves_nothing(bench: Connection) -> None:
    plan = bench.plan("escape", {"frames": 1500})
    assert plan.frames == 1500
    assert plan.seconds == pytest.approx(3.0)
    assert 0.1 < plan.stroke < 1
    assert bench.state.mirror.peak == 0.0
    few = bench.plan("docrime", {"frames": 20})
    assert "20 frames cannot constrain the modes" in few.warnings[0]
    with pytest.raises(ConfigError, match="'frame' is no argument of this procedure; did you mean 'frames'"):
        bench.plan("escape", {"frame": 3})
    with pytest.raises(
        ConfigError, match="poke is 3; it must be at least 1e-06 and at most 1 of full stroke"
    ):
        bench.plan("escape", {"poke": 3.0})


def test_a_failed_run_gives_the_reason_and_the_server_continues(bench: Connection) -> None:
    with pytest.raises(TooFewFrames, match="20 frames cannot constrain 30 modes"):
        bench.start("docrime", frames=20)
    run = bench.start("flat", frames=20)
    with pytest.raises(CalibrationError, match="no dark frame"):
        run.wait(60)
    until_idle(bench)
    assert bench.state.fault is None


def test_products_come_from_the_folders_of_the_server_only(
    bench: Connection, matrix: str, tmp_path: Path
) -> None:
    (own,) = (Path(one.path) for one in bench.state.products if one.name == matrix)
    product = bench.load_product(own, name="again")
    assert (product.name, product.kind) == ("again", "matrix")
    elsewhere = tmp_path / "im.fits"
    elsewhere.write_bytes(own.read_bytes())
    with pytest.raises(ProductError, match=r"this server reads from .* only"):
        bench.load_product(elsewhere)
    (own.parent / "link.fits").symlink_to(elsewhere)
    for way_out in (own.parent / "link.fits", own.parent.joinpath(*[".."] * 9, "etc", "passwd")):
        with pytest.raises(ProductError, match="reads from"):
            bench.load_product(way_out)


def test_who_only_watches_writes_nothing_but_may_always_stop(served: Served, bench: Connection) -> None:
    with served.connect() as watcher:
        assert not watcher.holds_lease
        with pytest.raises(LeaseHeld, match=r"has had control since"):
            watcher.start("docrime")
        with pytest.raises(LeaseHeld):
            watcher.acquire()
        run = bench.start("docrime", frames=10_000_000)
        wait_for(lambda: watcher.state.mirror.peak > 0, "pokes")
        watcher.flatten()
        assert watcher.state.mirror.peak == 0.0
        with pytest.raises(Aborted):
            run.wait(60)
        watcher.acquire(take_over=True)
        wait_for(lambda: not bench.holds_lease and watcher.holds_lease, "the lease has changed hands")
        with pytest.raises(LeaseHeld):
            bench.set_loop(gain=0.3)
        taken = [line.text for line in watcher.log_after(-1) if "takes control over from" in line.text]
        assert taken


@pytest.mark.slow
def test_the_page_on_the_server_can_be_followed(served: Served, bench: Connection) -> None:
    page = Path(__file__).parents[2] / "docs" / "server.md"
    block, *_ = re.findall(r"^```python\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)
    bench.release()
    wait_for(lambda: bench.latest("frames") is not None, "frames")
    script = block.replace('"razor-shwfs"', f'"{SYSTEM}"').replace("frames=1000", "frames=300")
    script = script.replace('"actuator", 48', '"actuator", 18').replace("mode 12", "mode 2")
    done = subprocess.run(
        [sys.executable, "-c", script], env=served.environment, capture_output=True, text=True, timeout=120
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("idle (200, 200)\n")
    until_idle(bench)
    bench.acquire()
    bench.set_offsets({})
    wait_for(lambda: bench.state.mirror.peak == 0.0, "a flat mirror")


@pytest.mark.slow
def test_two_clients_race_for_the_lease_a_thousand_times(served: Served, bench: Connection) -> None:
    bench.release()
    with served.connect() as one, served.connect() as other:
        start, end = threading.Barrier(2), threading.Barrier(2)
        won: dict[str, list[int]] = {"one": [], "other": []}

        def race(name: str, client: Connection) -> None:
            for number in range(1000):
                start.wait()
                try:
                    client.acquire()
                    won[name].append(number)
                except LeaseHeld:
                    pass
                end.wait()
                if won[name][-1:] == [number]:
                    client.release()

        threads = [threading.Thread(target=race, args=pair) for pair in (("one", one), ("other", other))]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
    # Each time one of them had it, and never both.
    assert sorted(won["one"] + won["other"]) == list(range(1000))


@pytest.mark.slow
def test_a_run_whose_holder_vanished_goes_on_and_control_is_free(system: Path, tmp_path: Path) -> None:
    with (
        serving(system, "--set", "server.lease_s=1.5", folder=tmp_path) as served,
        served.connect() as watcher,
    ):
        holder = served.connect(control=True)
        until_idle(watcher)
        run = holder.start("docrime", frames=5000)
        wait_for(lambda: watcher.state.mirror.peak > 0, "pokes")
        holder._link.close()  # as after the kill of a window
        wait_for(lambda: watcher.state.lease is None, "control is free")
        before = watcher.state.active_run
        assert before is not None
        assert watcher.state.unattended_limit_s == 0
        wait_for(lambda: watcher.state.unattended_for_s > 0.5, "the time without an operator")
        watcher.acquire()
        wait_for(lambda: watcher.state.last_run is not None, "the end of the run")
        assert (watcher.state.last_run.id, watcher.state.last_run.finish) == (run.id, Finish.DONE)
        assert watcher.state.fault is None


@pytest.mark.slow
def test_a_run_whose_holder_vanished_is_aborted_after_the_limit(system: Path, tmp_path: Path) -> None:
    limits = ("--set", "server.lease_s=1.5", "--set", "server.unattended_s=1")
    with serving(system, *limits, folder=tmp_path) as served, served.connect() as watcher:
        holder = served.connect(control=True)
        until_idle(watcher)
        holder.start("docrime", frames=10_000_000)
        wait_for(lambda: watcher.state.mirror.peak > 0, "pokes")
        holder._link.close()  # its heartbeat ends, and it cannot give the lease back
        wait_for(lambda: watcher.state.phase is Phase.FAULT, "the fault")
        assert "'docrime' (run 1) was without a client in control for" in watcher.state.fault.reason
        wait_for(lambda: watcher.state.last_run is not None, "the end of the run")
        assert watcher.state.last_run.finish is Finish.ABORTED
        assert Path(watcher.state.last_run.products["im"]).name == "im.partial.fits"
        assert watcher.state.mirror.peak == 0.0
        watcher.acquire()
        with pytest.raises(RequestRefused, match="clear the fault first"):
            watcher.start("docrime")
        watcher.clear_fault()
        until_idle(watcher)
