"""The window's one timer: every panel that can be seen looks for news at its own rate."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable

from PySide6.QtCore import QObject, Qt, QTimer

from escape_gui.client.session import Session
from escape_gui.panels.base import Panel

log = logging.getLogger(__name__)
TICK_MS = 33


class UpdateTimer(QObject):
    """Pulls panels; a panel that fails is set aside with the reason on it, the others go on.

    Parameters
    ----------
    session
        Where the data come from.
    panels
        All panels, seen or not.
    chores
        What the window itself does at 5 Hz.
    """

    def __init__(self, session: Session, panels: Iterable[Panel], on_slow_tick: Callable[[], None]) -> None:
        super().__init__()
        self._session, self._panels, self._on_slow_tick = session, list(panels), on_slow_tick
        self._due = {panel.name: 0.0 for panel in self._panels}
        self._slow_tick_due = 0.0
        self.frozen = False
        self.failed_panels: dict[str, str] = {}
        session.changed.connect(self._reset_failures)
        self._timer = QTimer(self)
        self._timer.setTimerType(Qt.TimerType.PreciseTimer)
        self._timer.timeout.connect(self.tick)

    def start(self) -> None:
        """Begin."""
        self._timer.start(TICK_MS)

    def stop(self) -> None:
        """End."""
        self._timer.stop()

    def tick(self, *, force: bool = False) -> None:
        """One round; ``force`` pulls each visible panel whether its time has come or not."""
        now = time.monotonic()
        if not self.frozen:
            for panel in self._panels:
                if force or now >= self._due[panel.name]:
                    self._refresh_if_due(panel, now)
        if force or now >= self._slow_tick_due:
            self._slow_tick_due = now + 0.2
            self._on_slow_tick()

    def _refresh_if_due(self, panel: Panel, now: float) -> None:
        if panel.name in self.failed_panels or not is_on_screen(panel):
            return
        # Half a tick less, or rates that divide the timer's would lose every second turn.
        self._due[panel.name] = now + 1 / panel.rate_hz - TICK_MS / 2000
        self._refresh_panel(panel)

    def _refresh_panel(self, panel: Panel) -> None:
        try:
            panel.refresh_from(self._session.source)
        except Exception as error:
            log.exception("panel '%s' failed", panel.name)
            reason = str(error) or type(error).__name__
            self.failed_panels[panel.name] = reason
            panel.show_placeholder(
                True, f"This panel has stopped: {reason}\n\nThe log has the details. The rest goes on."
            )

    def _reset_failures(self) -> None:
        """With another source a panel gets another chance."""
        self.failed_panels.clear()


def is_on_screen(panel: Panel) -> bool:
    """Whether any of it is on the screen: not hidden, not behind another tab, not minimised."""
    return panel.isVisible() and not panel.window().isMinimized() and not panel.visibleRegion().isEmpty()
