"""A bench without optics and procedures without physics, for the tests of the command line."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import fake_results as fake
import pytest

from escape_hw.api.procedure import Progress
from escape_hw.calibration.loop.gain_search import GainSearch
from escape_hw.config.loader import load_system
from escape_hw.errors import Aborted


class FakeScreen:
    def __init__(self) -> None:
        self.state = SimpleNamespace(inserted=True)

    def set(self, inserted: bool) -> None:
        self.state.inserted = inserted


class FakeBench:
    """Looks like an open system; remembers what happened to it."""

    def __init__(self, config: Any) -> None:
        self.config = config
        self.simulated = config.system.mode == "sim"
        info = SimpleNamespace(serial="SIM97", layout=fake.layout())
        self.dm = SimpleNamespace(info=info, applies_twin_section=self.simulated)
        camera = SimpleNamespace(serial="SIMCAM", full_scale=1023)
        self.wfs = self.science = SimpleNamespace(info=camera, applies_twin_section=self.simulated)
        self.screen, self.modulator = FakeScreen(), None
        self.closed = False
        self.screen_seen: dict[str, bool] = {}

    def __enter__(self) -> FakeBench:
        return self

    def __exit__(self, *_: object) -> None:
        self.closed = True


def steps(stage: str, n: int = 3):
    for i in range(n):
        yield Progress(stage, i + 1, n, metrics={"rms": 1.0}, elapsed_s=0.1)


class FakeProcedures:
    """Stand-ins for the calibration procedures; ``hook`` runs in the middle of each."""

    def __init__(self) -> None:
        self.hook: Callable[[str], None] = lambda name: None
        self.calls: list[tuple[str, dict[str, Any]]] = []
        self.changes: dict[str, Any] = {}
        self.benches: list[FakeBench] = []

    def _calibrate(self, bench: FakeBench, name: str, **options: Any):
        # Where the state of a run goes is no option of the calibration.
        shown = {key: value for key, value in options.items() if value is not None and key != "checkpoint"}
        self.calls.append((name, shown))
        bench.screen_seen[name] = bench.screen.state.inserted
        try:
            yield from steps(name)
            self.hook(name)
            yield from steps(name)
        except Aborted:
            return fake.calibration(name, partial=True)
        return replace(fake.calibration(name), **self.changes)

    def push_pull(self, bench: FakeBench, **options: Any):
        return self._calibrate(bench, "push-pull", **options)

    def docrime(self, bench: FakeBench, **options: Any):
        return self._calibrate(bench, "docrime", **options)

    def escape(self, bench: FakeBench, **options: Any):
        return self._calibrate(bench, "escape", **options)

    def estimate_registration(self, matrix: Any, model: Any, **options: Any):
        self.calls.append(("sprint", {"method": matrix.method, **options}))
        yield from steps("SPRINT")
        return fake.registration()

    def close_loop(self, bench: FakeBench, matrix: Any, grid: Any, **options: Any):
        self.calls.append(("closed_loop", {"method": matrix.method, **options}))
        bench.screen_seen["loop"] = bench.screen.state.inserted
        try:
            yield from steps("closed loop")
            self.hook("closed_loop")
            yield from steps("closed loop")
        except Aborted:
            return fake.loop(matrix.method, partial=True)
        return replace(fake.loop(matrix.method), **self.changes)

    def find_best_gain(self, bench: FakeBench, matrix: Any, grid: Any, **options: Any):
        self.calls.append(("best_gain", {"method": matrix.method}))
        yield from steps("gain")
        return GainSearch(0.35, 0.02, [replace(fake.loop(matrix.method), gain=g) for g in (0.25, 0.35, 0.45)])

    def nominal_calibration(self, bench: FakeBench, grid: Any, m2c: Any):
        self.calls.append(("simulated", {}))
        return fake.calibration("simulated")

    def synthesise_from_measurement(self, measured: Any, model: Any, estimate: Any):
        matrix = replace(measured.matrix, method="escape")
        return replace(measured, matrix=matrix, registration=estimate)

    def measure_model_psf(self, bench: FakeBench, **options: Any):
        bench.screen_seen["model_psf"] = bench.screen.state.inserted
        yield from steps("model PSF")
        self.hook("model_psf")
        yield from steps("model PSF")
        return fake.psf(1.0)


def install(monkeypatch: pytest.MonkeyPatch) -> FakeProcedures:
    """Put the stand-ins where the command line looks for the real ones."""
    made = FakeProcedures()
    places = {
        "push_pull.procedure": ("push_pull",),
        "docrime.open_loop": ("docrime",),
        "escape.method": ("escape",),
        "sprint.fit": ("estimate_registration",),
        "loop.performance": ("close_loop",),
        "loop.gain_search": ("find_best_gain",),
        "acquisition.model_psf": ("measure_model_psf",),
        "sprint.synthetic_matrix": ("nominal_calibration", "synthesise_from_measurement"),
    }
    # All of them are imported first: a module that is imported later would keep a replaced function.
    for module in places:
        importlib.import_module(f"escape_hw.calibration.{module}")
    for module, names in places.items():
        for name in names:
            monkeypatch.setattr(f"escape_hw.calibration.{module}.{name}", getattr(made, name))
    monkeypatch.setattr("escape_hw.calibration.docrime.open_loop.require_enough_frames", lambda *_: None)

    def open_system(system: str, *, set: Any = (), seed: Any = None, mode: Any = None) -> FakeBench:
        made.benches.append(FakeBench(load_system(system, overrides=set, seed=seed, mode=mode)))
        return made.benches[-1]

    def from_config(config: Any) -> FakeBench:
        made.benches.append(FakeBench(config))
        return made.benches[-1]

    monkeypatch.setattr("escape_hw.runtime.session.system.open_system", open_system)
    monkeypatch.setattr("escape_hw.paper.paired_seeds.Bench", SimpleNamespace(from_config=from_config))
    monkeypatch.setattr("escape_hw.config.registry.model_factory", lambda name: lambda config, grid: None)
    return made
