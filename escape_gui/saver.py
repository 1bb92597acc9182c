"""Asks where, saves what is on the screen, and says where it lies or why it does not."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING

from PySide6.QtWidgets import QFileDialog

from escape_gui import exports
from escape_gui.panels.panel import Panel
from escape_gui.widgets.status_pill import Level
from escape_hw.errors import EscapeError

if TYPE_CHECKING:
    from escape_gui.main_window import MainWindow


class Saver:
    """Saves panels, and the window.

    Parameters
    ----------
    window
        Whose panels.
    """

    def __init__(self, window: MainWindow) -> None:
        self._window = window

    def panel(self, kind: str, panel: Panel | None = None) -> None:
        """Ask where, then save a panel as ``png``, ``csv`` or ``fits``; the one in focus by default."""
        panel = panel or self._window.panel_in_focus()
        if panel is None:
            why = "Click a panel first, or use the ⤓ in its title."
            self._window.toasts.tell(Level.WARN, "Which panel?", why)
            return
        path = self._ask(panel.name, kind)
        if path is not None:
            self.panel_to(path, kind, panel)

    def window(self) -> None:
        """Ask where, then save the whole window as a picture."""
        path = self._ask("window", "png")
        if path is not None:
            self._save(lambda: exports.save_png(path, self._window))

    def panel_to(self, path: Path, kind: str, panel: Panel) -> None:
        """Save a panel into this file."""
        if kind == "png":
            self._save(lambda: exports.save_png(path, panel))
        elif kind == "csv":
            self._save(lambda: exports.save_csv(path, panel))
        else:
            state = self._window.context.session.source.state
            self._save(lambda: exports.save_fits(path, panel, state))

    def _save(self, save: Callable[[], tuple[Path, ...]]) -> None:
        try:
            written = save()
        except EscapeError as error:
            self._window.toasts.tell(Level.BAD, "Not saved", str(error))
            return
        self._window.note("saved", f"saved {written[-1].name}")
        self._window.toasts.tell(Level.GOOD, "Saved", "\n".join(str(path) for path in written))

    def _ask(self, name: str, kind: str) -> Path | None:
        moment = datetime.now().strftime("%Y-%m-%d_%H%M%S")
        proposal = str(Path.home() / f"escape_{name}_{moment}.{kind}")
        chosen, _ = QFileDialog.getSaveFileName(self._window, f"Save {name}", proposal, f"*.{kind}")
        return Path(chosen) if chosen else None
