"""What a window costs: one tick of all visible panels, with and without drawing, by workspace.

Every stream has a new entry at each tick, which is the most that can happen; a tick's budget is 8 ms.
Times are those of the processor, so that other programs do not count:
``python benchmarks/studies/gui_frame_budget.py``.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tests" / "gui"))

from scripted import ScriptedControl, ScriptedSource

from escape_gui.app import qt_application
from escape_gui.client.session import Session
from escape_gui.main_window import MainWindow
from escape_gui.panels.modes import ModesPanel
from escape_gui.settings import Settings
from escape_gui.views.images import mask_from_rows
from escape_gui.window.docks import WORKSPACES
from escape_hw.remote.source import Sample
from escape_hw.remote.state import ActiveRun, Phase

BUDGET_MS = 8.0
TICKS = 150
PERIOD_S = 0.033
#: Entries prepared beforehand, so that making them is not measured.
N_ENTRIES = 8


def prepare_entries() -> list[dict[str, Sample]]:
    """Sets of entries for all streams."""
    source = ScriptedSource()
    sets = []
    for seed in range(N_ENTRIES):
        source.push_all(seed)
        rng, valid = np.random.default_rng(seed), mask_from_rows(source.geometry_data.valid)
        matrix = rng.normal(0, 1, (2 * int(valid.sum()), source.geometry_data.n_modes)).astype(np.float32)
        source.push("valid", valid.astype(np.uint8))
        source.push("matrix", matrix, stage="DO-CRIME")
        source.push("matrix_sigma", np.full_like(matrix, 0.3))
        sets.append(dict(source.streams))
    return sets


def measure(name: str, size: tuple[int, int], sets: list[dict[str, Sample]]) -> tuple[float, float, float]:
    """Median and 95th percentile of a tick, and median with drawing, in milliseconds."""
    qt = qt_application()
    session, source = Session(), ScriptedSource()
    window = MainWindow(session, Settings(workspace=name))
    window.resize(*size)
    session.set_source(source, ScriptedControl())
    window.show()
    qt.processEvents()
    _push(source, sets[0])
    if name == "calibrate":
        _start_calibration(window, source)
    ticks, drawn = [], []
    due = time.perf_counter()
    for k in range(TICKS):
        entries = sets[k % N_ENTRIES]
        _push(source, entries)
        source.change(rates=source.state.rates.model_copy(update={"frames": k}))
        start = time.process_time()
        window.update_timer.tick()
        pulled = time.process_time()
        qt.processEvents()
        ticks.append(1e3 * (pulled - start))
        drawn.append(1e3 * (time.process_time() - start))
        due = max(due + PERIOD_S, time.perf_counter())
        time.sleep(max(0.0, due - time.perf_counter()))
    window.close()
    session.close()
    kept = slice(TICKS // 5, None)
    return float(np.median(ticks[kept])), float(np.percentile(ticks[kept], 95)), float(np.median(drawn[kept]))


def _push(source: ScriptedSource, entries: dict[str, Sample]) -> None:
    for stream, sample in entries.items():
        source.push(stream, sample.data, **sample.meta)


def _start_calibration(window: MainWindow, source: ScriptedSource) -> None:
    """A matrix that grows, one of its modes in detail, and the camera beside it."""
    running = ActiveRun(id=1, name="docrime", arguments={}, stage="DO-CRIME", total=10_000)
    source.change(procedure=running, phase=Phase.PROCEDURE)
    window.docks["camera"].raise_()
    window.update_timer.tick(force=True)
    modes = window.panels["modes"]
    assert isinstance(modes, ModesPanel)
    modes.mosaic.choose(9)
    assert modes.detail.isVisibleTo(window), "nothing is shown that could be measured"


def main() -> None:
    sets = prepare_entries()
    print(
        f"{'workspace':<11}{'size':<12}{'tick ms':>9}{'p95 ms':>9}{'drawn ms':>10}   budget {BUDGET_MS:g} ms"
    )
    for size in ((1280, 800), (2560, 1440)):
        for one in WORKSPACES:
            tick, high, drawn = measure(one.name, size, sets)
            verdict = "within" if tick <= BUDGET_MS else "over"
            print(
                f"{one.name:<11}{size[0]}x{size[1]:<7}{tick:>9.2f}{high:>9.2f}{drawn:>10.2f}   {verdict}",
                flush=True,
            )


if __name__ == "__main__":
    main()
