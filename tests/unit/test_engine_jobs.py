"""An engine whose jobs cannot begin, what order it tells its states in, and a front without a guardian."""

from __future__ import annotations

import itertools
import logging
import threading
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from escape_hw.errors import DeviceLost, EscapeError, RequestRefused
from escape_hw.remote.state import Finish, Phase
from escape_hw.server.engine import runner as jobs
from escape_hw.server.engine.state import EngineState, LoopSettings
from escape_hw.server.engine.state_publisher import StatePublisher
from escape_hw.server.frontend.engine_supervisor import Backoff, EngineProcess


class Engine:
    """An engine whose camera has gone, as its jobs see it."""

    def __init__(self) -> None:
        self.engine_state = EngineState(LoopSettings(gain=0.4), phase=Phase.IDLE)
        self.bench = SimpleNamespace(wfs=self, config=SimpleNamespace(to_toml=str))
        self.config = SimpleNamespace(system=SimpleNamespace(name="small"))
        self.publisher = SimpleNamespace(reset_residual=lambda: None)
        self.state_publisher = SimpleNamespace(publish=lambda: None)
        self.posted: list[dict[str, Any]] = []
        self.channel = SimpleNamespace(post=self.posted.append)
        self.flat = 0

    def stop(self) -> None:
        raise DeviceLost("wfs", "the camera has gone")

    def post(self, job: Any) -> None:
        job()

    def flatten(self) -> None:
        self.flat += 1

    def make_safe(self, reason: str, way_out: str) -> None:
        self.engine_state.latch_fault(reason, way_out)
        self.engine_state.phase, self.engine_state.closed = Phase.FAULT, False

    def send_flat_replies(self) -> None:
        """Nobody waits."""


@pytest.fixture
def engine(monkeypatch: pytest.MonkeyPatch) -> Engine:
    monkeypatch.setattr(jobs, "load_fitting_matrix", lambda engine, name: SimpleNamespace(result=None))
    monkeypatch.setattr(jobs, "LoopControl", lambda *args, **options: SimpleNamespace(opened=False))
    return Engine()


def test_a_loop_that_cannot_be_closed_is_told_and_none_is_thought_closed(engine: Engine) -> None:
    told: list[EscapeError | None] = []
    jobs.close_loop(engine, LoopSettings("im"), told.append)
    assert [str(error) for error in told] == ["wfs: the camera has gone"]
    assert engine.engine_state.fault is not None
    assert (engine.engine_state.loop_control, engine.engine_state.closed) == (None, False)


def test_a_run_that_cannot_begin_ends(
    engine: Engine, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(jobs, "_run_folder_path", lambda engine, task, run: tmp_path / "run")
    jobs.begin_run(engine, 3, "docrime", {}, loop=False)
    jobs.run_task(engine, SimpleNamespace(kind="docrime"), engine.bench.config)
    assert engine.engine_state.running is None
    assert engine.engine_state.last.finish is Finish.FAILED
    assert engine.engine_state.last.message == "wfs: the camera has gone"
    assert engine.engine_state.phase is Phase.FAULT
    assert engine.flat == 1
    assert engine.posted[-1]["ended"]["id"] == 3


def test_a_loop_that_somebody_opens_is_none_to_return_to(engine: Engine) -> None:
    engine_state = engine.engine_state
    engine_state.loop_control, engine_state.phase = SimpleNamespace(opened=False), Phase.LOOP
    assert jobs.loop_to_restore(engine) == engine_state.loop
    engine_state.stop.set()
    assert jobs.loop_to_restore(engine) is None
    with pytest.raises(RequestRefused, match="the loop is closed"):
        engine_state.require_idle()


@pytest.fixture
def process() -> Any:
    """The front's side of an engine whose guardian is dead, and a clock."""
    made: Any = EngineProcess.__new__(EngineProcess)
    made.now = 1000.0
    made._failsafe, made._backoff = SimpleNamespace(pid=4711), Backoff(lambda: made.now)
    return made


def test_a_guardian_that_cannot_be_started_is_no_end_of_the_server(
    process: Any, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    def refuse(process: EngineProcess) -> None:
        raise BlockingIOError("Resource temporarily unavailable")

    monkeypatch.setattr(EngineProcess, "_start_failsafe", refuse)
    process.now += 1
    with caplog.at_level(logging.ERROR):
        process.maintain_failsafe(alive=False)
    assert process._failsafe.pid == 4711
    assert "tried again in 2 s: Resource temporarily unavailable" in caplog.text


def test_a_guardian_that_dies_at_once_is_started_less_and_less_often(
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
    assert caplog.text.count("died; another one takes its place") == len(starts)
    # One that lived for a minute and is then killed is replaced at once, as the first one was.
    for alive in [True] * 60 + [False]:
        process.now += 1
        process.maintain_failsafe(alive)
    assert starts[-1] == 244


def test_no_older_state_is_told_after_a_newer_one() -> None:
    """Else a client that waits for what it asked for would find what was before."""
    told: list[int] = []
    begun, numbers = threading.Event(), itertools.count()

    class Slow(StatePublisher):
        def state(self) -> Any:
            number = next(numbers)
            begun.set()
            time.sleep(0.3 if number == 0 else 0.0)
            return number

    nothing: Any = None
    state_publisher = Slow(nothing, nothing, nothing, nothing, Path(), told.append)
    first = threading.Thread(target=state_publisher.publish)
    first.start()
    assert begun.wait(60)
    state_publisher.publish()
    first.join()
    assert told == [0, 1]
