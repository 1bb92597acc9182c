"""Limits of the engine's silence, with an engine that never sends a message."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from escape_hw.config.loader import load_system
from escape_hw.remote.state import ProductEntry, RecordingState, State
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.frontend import engine_supervisor
from escape_hw.server.frontend.engine_supervisor import EngineSupervisor
from escape_hw.server.ipc.channel import EngineSetup

PID, NOW_S = 4711, 1000.0


class SilentEngine:
    """An engine whose last message came 20 s ago."""

    last_message_s = NOW_S - 20

    def __init__(self, setup: EngineSetup, *_: object) -> None:
        self.setup = setup
        self.killed = False
        self.process = SimpleNamespace(pid=PID, running=True, kill=lambda: setattr(self, "killed", True))
        self.failsafe = SimpleNamespace(running=True)

    def send(self, message: Any) -> None:
        pass

    flush = maintain_failsafe = lambda self, *_: None


def supervise(monkeypatch: pytest.MonkeyPatch, state: State) -> EngineSupervisor:
    """A supervisor after this state."""
    monkeypatch.setattr(engine_supervisor, "EngineProcess", SilentEngine)
    setup = EngineSetup(config_text="", runs=Path(), read_folders=())
    return EngineSupervisor(
        load_system("razor-shwfs").server, setup, SimpleNamespace(folder="", system="razor-shwfs"),
        SimpleNamespace(state=state), on_message=print, on_exit=print,
    )  # fmt: skip


def test_the_next_engine_knows_the_products_of_the_one_before(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    (tmp_path / "im.fits").touch()
    kept, deleted = (
        ProductEntry(name=name, kind="matrix", path=str(tmp_path / f"{name}.fits")) for name in ("im", "gone")
    )
    supervisor = supervise(monkeypatch, State(products=(kept, deleted)))
    setup = supervisor.running_engine.setup
    store = ProductStore((setup.runs,), setup.products)
    assert store.products == (kept,)
    assert store.matrix_path("im") == tmp_path / "im.fits"


@pytest.mark.parametrize(
    ("engine_pid", "peak", "killed"), [(PID, 0.1, True), (PID, 0.0, False), (0, 0.1, False)],
    ids=["moving", "flat", "the mirror of the engine before"],
)  # fmt: skip
def test_a_silent_engine(monkeypatch: pytest.MonkeyPatch, engine_pid: int, peak: float, killed: bool) -> None:
    monkeypatch.setattr(engine_supervisor, "time", SimpleNamespace(monotonic=lambda: NOW_S))
    state = State(engine_pid=engine_pid)
    state = state.model_copy(update={"mirror": state.mirror.model_copy(update={"peak": peak})})
    supervisor = supervise(monkeypatch, state)
    supervisor.check(0.0)
    assert supervisor.running_engine.killed is killed


def test_a_recording_ends_with_its_engine(monkeypatch: pytest.MonkeyPatch) -> None:
    state = State(engine_pid=PID, recording=RecordingState(recording=True, path="here", written=100))
    supervisor = supervise(monkeypatch, state)
    published: list[State] = []
    supervisor._published.update = published.append
    supervisor._publish_fault("the engine died")
    recording = published[-1].recording
    assert not recording.recording
    assert (recording.path, recording.written) == ("here", 100)
    assert "the engine has ended" in recording.fault
