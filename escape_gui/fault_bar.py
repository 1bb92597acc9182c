"""Says why the mirror was made safe and what to do, until somebody clears it."""

from __future__ import annotations

from PySide6.QtGui import QAction
from PySide6.QtWidgets import QHBoxLayout, QLabel, QWidget

from escape_gui.panels.panel import Context
from escape_gui.widgets.hold_button import HoldButton
from escape_gui.widgets.status_pill import Level, StatusPill
from escape_hw.remote.state import State


class FaultBar(QWidget):
    """A row under the band that is only there while there is a fault.

    Parameters
    ----------
    context
        Theme and session.
    clear
        The action that ends the latch.
    """

    def __init__(self, context: Context, clear: QAction) -> None:
        super().__init__()
        self._pill = StatusPill(context.theme)
        self._pill.show_condition(Level.BAD, "FAULT")
        self._text = QLabel()
        self._text.setWordWrap(True)
        self._button = HoldButton("clear", context.theme)
        self._button.held.connect(clear.trigger)
        clear.changed.connect(lambda: self._follow(clear))
        row = QHBoxLayout(self)
        row.setContentsMargins(8, 4, 8, 4)
        row.addWidget(self._pill)
        row.addWidget(self._text, 1)
        row.addWidget(self._button)
        self.hide()

    def _follow(self, clear: QAction) -> None:
        self._button.setEnabled(clear.isEnabled())
        self._button.setToolTip(clear.toolTip())

    def show_state(self, state: State) -> None:
        """Appear or go."""
        fault = state.fault
        if fault is not None:
            text = f"{fault.reason} · {fault.at_utc}"
            self._text.setText(f"{text}\n{fault.way_out}" if fault.way_out else text)
        # Shown before it has its words it would take another height for a moment.
        self.setVisible(fault is not None)
