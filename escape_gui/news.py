"""Turns changes of the state into notes: a run has ended, a fault, the server has gone or come back."""

from __future__ import annotations

from escape_gui.widgets.status_pill import Level
from escape_gui.widgets.toasts import Toasts
from escape_hw.remote.state import Finish, State

_LEVELS = {Finish.DONE: Level.GOOD, Finish.ABORTED: Level.WARN, Finish.FAILED: Level.BAD}


class News:
    """Compares each state with the one before.

    Parameters
    ----------
    toasts
        Where notes are shown.
    """

    def __init__(self, toasts: Toasts) -> None:
        self._toasts = toasts
        self._state: State | None = None
        self._connected = False

    def look(self, state: State, *, connected: bool) -> None:
        """Tell what is new."""
        before, was_connected = self._state, self._connected
        self._state, self._connected = state, connected
        if was_connected and not connected:
            self._toasts.tell(
                Level.BAD,
                "Server lost",
                "No word from the server. The window tries again by itself.",
                stays=False,
            )
        if not connected:
            return
        if before is None or not was_connected:
            for note in state.notes:
                self._toasts.tell(Level.WARN, "Found at start", note)
        if before is None:
            return
        if state.fault is not None and state.fault != before.fault:
            self._toasts.tell(Level.BAD, "Fault, mirror made safe", state.fault.reason)
        if state.last is not None and state.last != before.last:
            last = state.last
            where = f"\n{last.folder}" if last.folder else ""
            self._toasts.tell(
                _LEVELS[last.finish], f"{last.name} {last.finish.value}", f"{last.message}{where}".strip()
            )
