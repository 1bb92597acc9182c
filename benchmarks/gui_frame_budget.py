"""What a window costs: one tick of all visible panels, with and without drawing, by workspace.

Every stream has a new entry at each tick, which is the most that can happen; a tick's budget is 8 ms.
Times are those of the processor, so that other programs do not count:
``python benchmarks/gui_frame_budget.py``.
"""

from __future__ import annotations

import os
import sys
import time
from pathlib import Path

import numpy as np

os.environ.setdefault("QT_QPA_PLATFORM", "offscreen")
sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "gui"))

from scripted import ScriptedControl, ScriptedSource

from escape_gui.app import application
from escape_gui.main_window import MainWindow
from escape_gui.session import Session
from escape_gui.settings import Settings
from escape_gui.workspaces import WORKSPACES

BUDGET_MS = 8.0
TICKS = 150
PERIOD_S = 0.033
#: Entries prepared beforehand, so that making them is not measured.
PREPARED = 8


def prepared() -> list[dict[str, object]]:
    """Sets of entries for all streams."""
    source = ScriptedSource()
    sets = []
    for seed in range(PREPARED):
        source.push_all(seed)
        sets.append(dict(source.streams))
    return sets


def measure(name: str, size: tuple[int, int], sets: list[dict[str, object]]) -> tuple[float, float, float]:
    """Median and 95th percentile of a tick, and median with drawing, in milliseconds."""
    qt = application()
    session, source = Session(), ScriptedSource()
    window = MainWindow(session, Settings(workspace=name))
    window.resize(*size)
    session.use(source, ScriptedControl())
    window.show()
    qt.processEvents()
    ticks, drawn = [], []
    due = time.perf_counter()
    for k in range(TICKS):
        entries = sets[k % PREPARED]
        for stream, sample in entries.items():
            source.push(stream, sample.data, **sample.meta)
        source.change(rates=source.state.rates.model_copy(update={"frames": k}))
        start = time.process_time()
        window.ticker.tick()
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


def main() -> None:
    sets = prepared()
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
