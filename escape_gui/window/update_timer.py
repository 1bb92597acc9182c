"""The timer of a window, which refreshes each visible panel at the panel's rate."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable

from PySide6.QtCore import QObject, Qt, QTimer

from escape_gui.client.session import Session
from escape_gui.panels.base import Panel

log = logging.getLogger(__name__)
TICK_MS = 33
_SLOW_TICK_S = 0.2


class UpdateTimer(QObject):
    """Refreshes visible panels, and calls ``on_slow_tick`` five times a second.

    A panel that raises is disabled and shows the reason.
    """

    def __init__(self, session: Session, panels: Iterable[Panel], on_slow_tick: Callable[[], None]) -> None:
        super().__init__()
        self._session, self._panels, self._on_slow_tick = session, list(panels), on_slow_tick
        self._due = {panel.name: 0.0 for panel in self._panels}
        self._slow_tick_due = 0.0
        self.frozen = False
        #: Reason by name of the panel; cleared when the source changes.
        self.failed_panels: dict[str, str] = {}
        session.changed.connect(self._reset_failures)
        self._timer = QTimer(self)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.timeout.connect(self.tick)

    def start(self) -> None:
        self._timer.start(TICK_MS)

    def stop(self) -> None:
        self._timer.stop()

    def tick(self, *, force: bool = False) -> None:
        """Refresh the visible panels that are due; ``force``: all visible panels."""
        now = time.monotonic()
        if not self.frozen:
            for panel in self._panels:
                due = force or now >= self._due[panel.name]
                if due and panel.name not in self.failed_panels and is_on_screen(panel):
                    # Half a tick less: otherwise rates that divide the timer's would skip every second tick.
                    self._due[panel.name] = now + 1 / panel.rate_hz - TICK_MS / 2000
                    self._refresh_panel(panel)
        if force or now >= self._slow_tick_due:
            self._slow_tick_due = now + _SLOW_TICK_S
            self._on_slow_tick()

    def _refresh_panel(self, panel: Panel) -> None:
        try:
            panel.refresh_from(self._session.source)
        except Exception as error:
            log.exception("panel '%s' failed", panel.name)
            reason = str(error) or type(error).__name__
            self.failed_panels[panel.name] = reason
            panel.show_placeholder(
                True, f"Panel failed: {reason}\n\nThe log has the details. Other panels are not affected."
            )

    def _reset_failures(self) -> None:
        self.failed_panels.clear()


def is_on_screen(panel: Panel) -> bool:
    """Whether any part of a panel is visible: not hidden, behind another tab or minimised."""
    return panel.isVisible() and not panel.window().isMinimized() and not panel.visibleRegion().isEmpty()
