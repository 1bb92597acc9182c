"""kill -9 of engine and front: the mirror is flattened, and no partial product remains."""

from __future__ import annotations

import os
import signal
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest
from serving import Served, serving, until_idle, wait_for
from stand_in_bench import OPTIONS, bench, guarded, on_metal, whole

from escape_hw.errors import CalibrationError, RequestRefused, ServerGone
from escape_hw.io.fits.matrix import load_matrix
from escape_hw.remote.address import ServerListing, local_endpoint, register_server, unregister_server
from escape_hw.remote.state import Phase
from escape_hw.streams.segments import segments
from escape_hw.supervision import process_start

__all__ = ["bench"]


def test_the_fail_safe_process_flattens_the_mirror_of_a_killed_engine(system, bench, tmp_path) -> None:
    server, spy = bench
    with on_metal(system, server, tmp_path) as served, served.connect(control=True) as client:
        until_idle(client)
        client.calibrate("docrime", frames=500)
        products = client.state.products
        assert [one.name for one in products if one.kind == "matrix"]
        run = client.start("docrime", frames=10_000_000)
        running = client.state.engine_pid
        wait_for(lambda: bool(list(tmp_path.rglob("run.state"))) and not spy.flat, "the mirror is poked")
        os.kill(running, signal.SIGKILL)
        with pytest.raises(CalibrationError, match=r"ended with its engine: the engine .* died; "):
            run.wait(60)
        wait_for(lambda: guarded(client), "the fail-safe process has ended")
        assert spy.flat
        assert client.state.phase is Phase.FAULT
        assert "offsets are zero" in client.state.fault.remedy
        assert not segments(pid=running)
        whole(tmp_path)
        # The accumulators were kept, and the next engine continues with them.
        client.clear_fault()
        until_idle(client)
        assert client.state.products == products, "the next engine knows the matrices of the one before"
        (state,) = tmp_path.rglob("run.state")
        kept = load_state_frames(state)
        result = client.calibrate("docrime", resume=str(state.parent), frames=kept + 500)
        assert result.frames == kept + 500
        # The log goes on over the end of the engine, without a gap.
        lines = client.log_after(-1)
        numbers = [line.number for line in lines]
        assert numbers == list(range(numbers[0], numbers[-1] + 1))
        assert sum("process" in line.text and "engine of" in line.text for line in lines) == 2
    assert spy.flat


def failsafe_of(served: Served) -> int:
    """Process number of the fail-safe process; 0 when there is none."""
    words = ("-f", "escape_hw.server.safety.failsafe", "-P", str(served.front))
    found = subprocess.run(("pgrep", *words), capture_output=True, text=True, check=False).stdout.split()
    return int(found[0]) if found else 0


@pytest.mark.slow
def test_a_killed_fail_safe_process_is_restarted_and_works(system, bench, tmp_path) -> None:
    server, spy = bench
    with on_metal(system, server, tmp_path) as served, served.connect(control=True) as client:
        until_idle(client)
        first = failsafe_of(served)
        os.kill(first, signal.SIGKILL)
        wait_for(lambda: failsafe_of(served) not in (0, first), "another fail-safe process")
        run = client.start("docrime", frames=10_000_000)
        wait_for(lambda: not spy.flat, "the mirror is poked")
        os.kill(client.state.engine_pid, signal.SIGKILL)
        with pytest.raises(CalibrationError, match=r"ended with its engine: the engine .* died; "):
            run.wait(60)
        wait_for(lambda: guarded(client), "the fail-safe process has ended")
        assert spy.flat


def load_state_frames(path: Path) -> int:
    from escape_hw.io.fits.run_state import load_state

    return int(load_state(path).values["fed"])


def test_the_command_line_is_told_that_a_server_holds_the_hardware(
    system, bench, tmp_path, monkeypatch, capsys
) -> None:
    from escape_hw.cli import main

    server, _ = bench
    tmp_path.chmod(0o700)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    name, pid = server.config.system.name, os.getpid()
    sockets = local_endpoint(name, pid)
    listing = ServerListing(name, pid, process_start(pid), sockets.requests, sockets.events)
    register_server(listing)
    words = ["calibrate", str(system), "--mode", "hardware", "--out", str(tmp_path / "run"), "--json"]
    with pytest.raises(SystemExit) as ended:
        main(words)
    assert ended.value.code == 2
    assert f"is served by process {pid}, which holds its devices" in capsys.readouterr().out
    unregister_server(listing)


@pytest.mark.slow
def test_a_front_that_was_killed_leaves_a_flat_mirror_and_a_note(system, bench, tmp_path) -> None:
    server, spy = bench
    # Longer than the path of a socket may be: the sockets are in a temporary folder.
    with on_metal(system, server, tmp_path / ("long" * 20)) as served:
        with served.connect(control=True) as client:
            until_idle(client)
            client.calibrate("docrime", frames=500)
            products = client.state.products
            assert [one.name for one in products if one.kind == "matrix"]
            run = client.start("docrime", frames=10_000_000)
            wait_for(lambda: bool(list(tmp_path.rglob("run.state"))) and not spy.flat, "the mirror is poked")
            front, engine = served.front, client.state.engine_pid
            served.kill()
            seconds = wait_for(lambda: spy.flat, "the mirror is flat")
            wait_for(lambda: served.front not in (0, front), "another front end")
            # The same connection reaches it, and the mirror stays flat.
            wait_for(lambda: client.state.engine_pid not in (0, engine), "another engine")
            until_idle(client)
            assert spy.flat
            assert client.state.active_run is None
            assert client.state.products == products, "the matrices are offered again"
            with pytest.raises(CalibrationError, match="ended with its engine: the previous server"):
                run.wait(60)
            client.acquire()
            assert client.start("docrime", frames=500).id == run.id + 1
            wait_for(
                lambda: any("run 2: " in line.text for line in client.log_after(-1)), "its line of the log"
            )
            client.abort()
            # Nothing that the other front end wrote is missing, also before this client was connected again.
            numbers = [line.number for line in client.log_after(-1)]
            assert sum(after - before != 1 for before, after in pairwise(numbers)) <= 1
        assert seconds < 30
        # The engine had the time to keep what was measured.
        (partial,) = tmp_path.rglob("im.partial.fits")
        assert load_matrix(partial).result.partial
        with served.connect() as client:
            notes = " / ".join(client.state.notes)
        assert "did not end cleanly" in notes
        assert "offsets are zero" in notes
        assert "docrime" in notes
        assert str(partial.parent) in notes


@pytest.mark.slow
def test_a_killed_supervisor_ends_the_server_with_a_flat_mirror(system, bench, tmp_path) -> None:
    server, spy = bench
    with on_metal(system, server, tmp_path) as served:
        with served.connect(control=True) as client:
            until_idle(client)
            client.start("docrime", frames=10_000_000)
            wait_for(lambda: not spy.flat, "the mirror is poked")
            os.kill(served.pid, signal.SIGKILL)
            wait_for(lambda: spy.flat, "the mirror is flat")
            wait_for(lambda: not served.engines(), "front end, engine and fail-safe process end")
            wait_for(lambda: not client.connected, "the client notices")
            with pytest.raises(ServerGone):
                client.start("docrime")
        assert spy.flat


@pytest.mark.slow
def test_an_engine_that_hangs_is_ended_and_its_mirror_made_flat(system, bench, tmp_path) -> None:
    server, spy = bench
    with (
        serving(
            system, "--mode", "hardware", "--set", OPTIONS[0], "--set", "server.engine_silence_s=5",
            folder=tmp_path, more=server.environment,
        ) as served,
        served.connect(control=True) as client,
    ):  # fmt: skip
        until_idle(client)
        client.start("docrime", frames=10_000_000)
        # It hangs at once, perhaps before a state with the first poke was published.
        wait_for(lambda: not spy.flat and spy.last is not None, "the mirror is poked")
        os.kill(client.state.engine_pid, signal.SIGSTOP)
        wait_for(lambda: guarded(client), "the fail-safe process has ended")
        assert "the engine was silent for 5." in client.state.fault.reason
        assert spy.flat
        with pytest.raises(RequestRefused, match="the engine has died; clear the fault to start it again"):
            client.start("docrime")
        client.clear_fault()
        until_idle(client)
