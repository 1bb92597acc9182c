"""A window that gets eight hours of states, log lines and night-log entries; prints its memory in MB.

Run as a process of its own, because the memory of a process contains everything that it ever did.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

from gui_windows import dispose, settle, show_window
from PySide6.QtCore import QCoreApplication
from scripted import ScriptedControl, ScriptedSource

from escape_gui.app import qt_application
from escape_gui.client.history import LoopHistory
from escape_gui.client.session import Session
from escape_hw.io.night_log import NightEntry
from escape_hw.io.provenance import format_utc
from escape_hw.remote.state import LogLine, LoopState

HOURS, STATES_PER_S, SAMPLE_S = 8, 5, 10
#: States between two refreshes of the window.
_REFRESH = 2000


def memory_mb(name: str = "VmRSS") -> float:
    """Resident memory of this process, or its largest (``VmHWM``).

    That of ``getrusage`` includes the process that started this one.
    """
    lines = Path("/proc/self/status").read_text().splitlines()
    (kilobytes,) = (line.split()[1] for line in lines if line.startswith(f"{name}:"))
    return 1024 * int(kilobytes) / 1e6


def feed(source: ScriptedSource, session: Session, set_time: Callable[[float], None], refresh) -> None:
    """Eight hours of history, one state after the other."""
    began = datetime.now(UTC) - timedelta(hours=HOURS)
    for k in range(HOURS * 3600 * STATES_PER_S):
        seconds = k / STATES_PER_S
        set_time(seconds)
        loop = LoopState(closed=True, matrix="escape", gain=0.4, strehl=0.4, residual_nm=40.0 + k % 7)
        source.change(loop=loop)
        session.history.update(source.state)
        at_utc = format_utc(began + timedelta(seconds=seconds))
        if k % (SAMPLE_S * STATES_PER_S) == 0:
            values = {"strehl": 40.0, "residual_nm": 40.0, "strength": 22.0, "r0_m": 2e-4, "shift_x": -16.0}
            source.night.append(
                NightEntry(number=len(source.night), at_utc=at_utc, kind="sample", values=values)
            )
            source.lines.append(
                LogLine(number=len(source.lines), at_utc=at_utc, level="INFO", logger="x", text=f"line {k}")
            )
        if k % (600 * STATES_PER_S) == 0:
            source.night.append(NightEntry(number=len(source.night), at_utc=at_utc, kind="note", text="note"))
        if k % _REFRESH == 0:
            refresh()


def main() -> None:
    """Feed the window, look at all panels, print the memory."""
    qt_application()
    source, session = ScriptedSource(), Session()
    source.push_all()
    session.set_source(source, ScriptedControl())
    clock = {"s": 0.0}
    session.history = LoopHistory(lambda: clock["s"])
    window = show_window(session, Path("gui.json"))
    start_mb = memory_mb()

    def refresh() -> None:
        source.push_all()
        window.update_timer.tick(force=True)
        QCoreApplication.processEvents()

    feed(source, session, lambda seconds: clock.update(s=seconds), refresh)
    for name in ("align", "calibrate", "operate"):
        window.show_workspace(name)
        refresh()
    for name in ("trends", "telemetry", "performance", "night", "log"):
        window.docks[name].raise_()
        refresh()
    n_states = session.history.strehl.arrays[0].size
    print(
        json.dumps({
            "start_mb": start_mb, "end_mb": memory_mb(), "states": n_states,
            "peak_mb": memory_mb("VmHWM"),
        })
    )  # fmt: skip
    dispose(window)
    session.close()
    settle()


if __name__ == "__main__":
    main()
