"""Procedures and loops that cannot start, transitions of the engine's state, and the fail-safe process."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from escape_hw.api.procedure import Progress
from escape_hw.errors import DeviceLost, EscapeError, RequestRefused
from escape_hw.remote.requests import CloseLoop
from escape_hw.remote.state import Finish, FinishedRun, Phase
from escape_hw.server.engine import runner
from escape_hw.server.engine.runner import LoopRunner, ProcedureRunner
from escape_hw.server.engine.state import EngineState, LoopParameters
from escape_hw.server.engine.state_publisher import StatePublisher
from escape_hw.server.frontend.engine_process import EngineProcess
from escape_hw.supervision import Backoff

CLOSED = LoopParameters("im", 0.3, 0.01, 2)
STORE: Any = SimpleNamespace(matrix_path=Path)


def idle_state() -> EngineState:
    state = EngineState(LoopParameters(gain=0.4), first_run_id=3)
    state.set_phase(Phase.IDLE)
    return state


def loop_control() -> Any:
    control = SimpleNamespace(opened=False)
    control.request_open = lambda: setattr(control, "opened", True)
    return control


class Owner:
    """Owner of a bench whose camera is lost. Jobs run at once."""

    def __init__(self) -> None:
        config = SimpleNamespace(system=SimpleNamespace(name="small"), to_toml=str)
        self.bench = SimpleNamespace(wfs=self, config=config, simulated=True)
        self.config, self.state = config, idle_state()
        self.publisher = SimpleNamespace(reset_residual=lambda: None)
        self.state_publisher = SimpleNamespace(publish=lambda: None)
        self.sent: list[Any] = []
        self.send = self.sent.append
        self.flat, self.failed_device = 0, ""

    def stop(self) -> None:
        raise DeviceLost("wfs", "the camera has gone")

    def post(self, job: Any) -> None:
        job()

    def flatten(self) -> None:
        self.flat += 1

    def make_safe(self, reason: str, remedy: str, device: str = "") -> None:
        self.state.enter_fault(reason, remedy)
        self.failed_device = device

    def send_flat_replies(self) -> None:
        """No request waits."""


@pytest.fixture
def owner(monkeypatch: pytest.MonkeyPatch) -> Owner:
    monkeypatch.setattr(runner, "load_fitting_matrix", lambda *args: SimpleNamespace(result=None))
    monkeypatch.setattr(runner, "require_hardware_matrix", lambda *args, **options: None)
    monkeypatch.setattr(runner, "LoopControl", lambda *args, **options: loop_control())
    owner = Owner()
    monkeypatch.setattr(runner, "load_text", lambda text, overrides: owner.bench.config)
    return owner


def procedure_runner(owner: Any, runs: Path) -> ProcedureRunner:
    loop_runner = LoopRunner(owner, STORE)
    return ProcedureRunner(owner, loop_runner, STORE, runs=runs)


def finished(run: int) -> FinishedRun:
    return FinishedRun(id=run, name="gains", finish=Finish.DONE)


def test_a_loop_that_cannot_be_closed_is_reported_and_does_not_count_as_closed(owner: Any) -> None:
    reported: list[EscapeError | None] = []
    request = CloseLoop(client="0" * 8, matrix="im")
    LoopRunner(owner, STORE).close(request, reported.append)
    now = owner.state.snapshot
    assert [str(error) for error in reported] == ["wfs: the camera has gone"]
    assert now.fault is not None
    assert owner.failed_device == "wfs"
    assert (now.loop_control, now.loop_closed, now.phase) == (None, False, Phase.FAULT)


def test_a_run_that_cannot_begin_ends(owner: Any, tmp_path: Path) -> None:
    task: Any = SimpleNamespace(kind="docrime", overrides=(), load=lambda config, simulated: None)
    assert procedure_runner(owner, tmp_path).start(task, "docrime", {}, needs_loop=False) == 3
    now = owner.state.snapshot
    assert now.active_run is None
    assert now.last_run is not None
    assert (now.last_run.finish, now.last_run.message) == (Finish.FAILED, "wfs: the camera has gone")
    assert now.phase is Phase.FAULT
    assert owner.flat == 1
    assert owner.sent[-1]["ended"]["id"] == 3


def test_a_closed_loop_is_opened_for_a_procedure_that_needs_one_and_closed_again() -> None:
    state, control = idle_state(), loop_control()
    state.begin_loop(CLOSED, control)
    with pytest.raises(RequestRefused, match="the loop is closed"):
        state.begin_run("docrime", {}, needs_loop=False)
    ticket = state.begin_run("gains", {}, needs_loop=True)
    assert (ticket.loop_before, control.opened, ticket.run.id) == (CLOSED, True, 3)
    state.end_loop()
    assert state.snapshot.needs_loop
    with pytest.raises(RequestRefused, match=r"'gains' \(run 3\) is running"):
        state.begin_loop(CLOSED, loop_control())
    stop = state.finish_run(finished(3), (CLOSED, control))
    assert stop is not None
    assert not stop.is_set()
    assert (state.snapshot.phase, state.snapshot.active_run) == (Phase.LOOP, None)


def test_a_loop_that_is_being_opened_is_not_restored() -> None:
    state = idle_state()
    state.begin_loop(CLOSED, loop_control())
    assert state.check_can_start(needs_loop=True) == CLOSED
    state.request_stop()
    with pytest.raises(RequestRefused, match="the loop is closed"):
        state.check_can_start(needs_loop=True)


@pytest.mark.parametrize("disturbance", ["stop", "fault"])
def test_after_a_stop_or_a_fault_the_loop_stays_open(disturbance: str) -> None:
    state = idle_state()
    state.begin_loop(CLOSED, loop_control())
    ticket = state.begin_run("gains", {}, needs_loop=True)
    state.end_loop()
    if disturbance == "stop":
        assert state.request_open_loop()
    else:
        state.latch_fault("it broke", "Fix it.")
    assert ticket.stop.is_set()
    assert state.finish_run(finished(3), (CLOSED, loop_control())) is None
    assert state.snapshot.phase is (Phase.IDLE if disturbance == "stop" else Phase.FAULT)


def test_a_snapshot_does_not_change_and_the_first_fault_stays() -> None:
    state = idle_state()
    before = state.snapshot
    state.begin_run("docrime", {}, needs_loop=False)
    state.set_device_message("wfs", "no frame")
    state.latch_fault("first", "Fix it.")
    state.enter_fault("second", "Fix it.")
    assert (before.phase, before.active_run, before.device_messages) == (Phase.IDLE, None, {})
    assert state.snapshot.fault is not None
    assert state.snapshot.fault.reason == "first"
    assert not state.request_open_loop()
    state.clear_fault()
    assert state.snapshot.fault is None


def test_only_a_procedure_in_open_loop_can_be_paused() -> None:
    state = idle_state()
    with pytest.raises(RequestRefused, match="no procedure is running"):
        state.pause()
    state.begin_run("track", {}, needs_loop=True)
    with pytest.raises(RequestRefused, match="cannot be paused"):
        state.pause()
    state.finish_run(finished(3))
    state.begin_run("docrime", {}, needs_loop=False)
    state.pause()
    assert state.snapshot.paused
    state.resume()
    assert not state.snapshot.paused


def test_concurrent_transitions_lose_nothing() -> None:
    """Each thread changes another part of the state; unlocked writes would overwrite each other."""
    state = idle_state()
    state.begin_run("docrime", {}, needs_loop=False)

    def set_messages(device: str) -> None:
        for number in range(500):
            state.set_device_message(device, str(number))

    threads = [threading.Thread(target=set_messages, args=(f"device {n}",)) for n in range(4)]
    for thread in threads:
        thread.start()
    for number in range(500):
        state.update_progress(Progress("poking", number, 500))
    for thread in threads:
        thread.join()
    now = state.snapshot
    assert now.device_messages == {f"device {n}": "499" for n in range(4)}
    assert now.active_run is not None
    assert now.active_run.completed == 499


@pytest.fixture
def process() -> Any:
    """The front end's side of an engine whose fail-safe process is dead, and a clock."""
    made: Any = EngineProcess.__new__(EngineProcess)
    made.now = 1000.0
    made.failsafe, made._backoff = SimpleNamespace(pid=4711), Backoff(lambda: made.now)
    return made


def test_a_fail_safe_process_that_cannot_be_started_does_not_end_the_server(
    process: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(process: EngineProcess) -> None:
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr(EngineProcess, "_start_failsafe", refuse)
    process.now += 1
    with caplog.at_level(logging.ERROR):
        process.maintain_failsafe(alive=False)
    assert process.failsafe.pid == 4711
    assert "next attempt in 2 s: Resource temporarily unavailable" in caplog.text


def test_a_fail_safe_process_that_ends_at_once_is_started_less_and_less_often(
    process: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    starts: list[float] = []

    def start(process: Any) -> SimpleNamespace:
        starts.append(process.now - 1000)
        return SimpleNamespace(pid=4712)

    monkeypatch.setattr(EngineProcess, "_start_failsafe", start)
    with caplog.at_level(logging.ERROR):
        for _ in range(183):
            process.now += 1
            process.maintain_failsafe(alive=False)
    assert starts == [1, 3, 7, 15, 31, 63, 123, 183]
    assert caplog.text.count("died; it is restarted") == len(starts)
    # A process that lived for a minute and is then killed is restarted at once, as the first one was.
    for alive in [True] * 60 + [False]:
        process.now += 1
        process.maintain_failsafe(alive)
    assert starts[-1] == 244


def test_no_older_state_is_published_after_a_newer_one() -> None:
    """Otherwise a client that waits for the effect of its request would find the state before."""
    published: list[int] = []
    begun, numbers = threading.Event(), itertools.count()

    class Slow(StatePublisher):
        def state(self) -> Any:
            number = next(numbers)
            begun.set()
            time.sleep(0.3 if number == 0 else 0.0)
            return number

    nothing: Any = None
    state_publisher = Slow(nothing, nothing, nothing, nothing, Path(), published.append)
    first = threading.Thread(target=state_publisher.publish)
    first.start()
    assert begun.wait(60)
    state_publisher.publish()
    first.join()
    assert published == [0, 1]
