"""Header of the window: connection banner, system state, safety buttons, fault banner."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QGridLayout, QHBoxLayout, QLabel, QPushButton, QVBoxLayout, QWidget

from escape_gui.client.availability import UNKNOWN_VALUE, has_frames, is_measured
from escape_gui.panels.base import Context
from escape_gui.widgets.controls.hold_button import HoldButton
from escape_gui.widgets.controls.readout import Readout
from escape_gui.widgets.controls.status_indicator import Level, StatusIndicator
from escape_hw.remote.state import Phase, State

PHASES: dict[Phase, Level] = {
    Phase.STARTING: Level.ACTIVE,
    Phase.IDLE: Level.GOOD,
    Phase.LOOP: Level.ACTIVE,
    Phase.PROCEDURE: Level.ACTIVE,
    Phase.FAULT: Level.ERROR,
    Phase.STOPPED: Level.NEUTRAL,
}
#: Share of saturated pixels from which the number is a warning, and from which it is bad.
SATURATION_WARNING, SATURATION_ERROR = 0.001, 0.01
#: What to do before a server was ever heard of.
NOT_CONNECTED_TEXT = "NOT CONNECTED · start a server with 'escape serve SYSTEM', or open a recording (File)"


class ConnectionBanner(QLabel):
    """The full-width band with the word SIMULATED, HARDWARE, REPLAY or NOT CONNECTED."""

    def __init__(self, context: Context) -> None:
        super().__init__()
        self._context = context
        self._palette_keys: tuple[str, str] = ("stop", "on_stop")
        self.setAlignment(Qt.AlignmentFlag.AlignCenter)
        context.theme.changed.connect(self._apply_theme)
        self.show_state(State(), connected=False, live=True)

    def show_state(self, state: State, *, connected: bool, live: bool) -> None:
        """Say what we are connected to."""
        where = f"{state.system} · seed {state.seed}" if state.simulated else state.system
        if not connected and not is_measured(state):
            word, looks = NOT_CONNECTED_TEXT, ("button", "text")
        elif not live:
            word, looks = f"REPLAY · {state.system}", ("button", "text")
        elif not connected:
            word, looks = "NOT CONNECTED · the numbers below are old", ("stop", "on_stop")
        elif state.simulated:
            word, looks = f"SIMULATED · {where}", ("simulated", "on_simulated")
        else:
            word, looks = f"HARDWARE · {where}", ("hardware", "on_hardware")
        if (word, looks) != (self.text(), self._palette_keys):
            self._palette_keys = looks
            self.setText(word)
            self._apply_theme()

    def _apply_theme(self) -> None:
        colours = self._context.theme.colours
        back, front = (getattr(colours, name) for name in self._palette_keys)
        self.setFont(self._context.theme.font(bold=True))
        self.setStyleSheet(f"background: {back}; color: {front}; padding: 3px;")


class HeaderBar(QWidget):
    """Strip, state in two rows, and the safety buttons at a place of their own.

    Parameters
    ----------
    context
        Theme and session.
    open_loop, flatten
        The actions behind the two buttons.
    """

    def __init__(self, context: Context, open_loop: QAction, flatten: QAction) -> None:
        super().__init__()
        theme = context.theme
        self._context = context
        self.connection_banner = ConnectionBanner(context)
        self.phase = StatusIndicator(theme, "procedure")
        self.loop = StatusIndicator(theme, "loop closed")
        self.light = StatusIndicator(theme, "saturated 0.00 %")
        self.control = StatusIndicator(theme, "nobody in control")
        self.readouts = {
            "rate": Readout(theme, "frames", "Hz", 6),
            "lost": Readout(theme, "lost", "frames", 6),
            "rms": Readout(theme, "mirror rms", "stroke", 5),
            "peak": Readout(theme, "peak", "stroke", 5),
            "latency": Readout(theme, "latency p99", "µs", 5),
            "jitter": Readout(theme, "jitter p99", "µs", 5),
        }
        self.open_button = _safety_button(open_loop, "Open loop")
        self.flatten_button = _safety_button(flatten, "FLATTEN")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(0)
        column.addWidget(self.connection_banner)
        column.addLayout(self._row())

    def _row(self) -> QHBoxLayout:
        grid = QGridLayout()
        grid.setHorizontalSpacing(24)
        grid.setVerticalSpacing(0)
        pills = ((self.phase, self.loop), (self.light, self.control))
        for k, pair in enumerate(pills):
            for row, widget in enumerate(pair):
                grid.addWidget(widget, row, k)
        pairs = (("rate", "lost"), ("rms", "peak"), ("latency", "jitter"))
        for k, names in enumerate(pairs, len(pills)):
            for row, name in enumerate(names):
                grid.addWidget(self.readouts[name], row, k, Qt.AlignmentFlag.AlignRight)
        line = QHBoxLayout()
        line.setContentsMargins(8, 4, 8, 4)
        line.setSpacing(8)
        line.addLayout(grid)
        line.addStretch()
        line.addWidget(self.open_button)
        line.addWidget(self.flatten_button)
        return line

    def show_state(self, state: State, *, connected: bool, live: bool, mine: bool) -> None:
        """Bring everything up to date."""
        self.connection_banner.show_state(state, connected=connected, live=live)
        known = live and is_measured(state)
        self._show_conditions(state, known=known)
        replay = connected and not live
        self._show_control(state, replay=replay, mine=mine)
        values = {
            "rate": f"{state.rates.frame_hz:.1f}",
            "lost": f"{state.rates.lost_frames:d}",
            "rms": f"{state.mirror.rms:.3f}",
            "peak": f"{state.mirror.peak:.3f}",
            # Nothing was late where no frame was answered in the last second.
            "latency": f"{state.latency.p99:.0f}" if state.latency.p99 else UNKNOWN_VALUE,
            "jitter": f"{state.latency.jitter_p99:.0f}" if state.latency.p99 else UNKNOWN_VALUE,
        }
        for name, text in values.items():
            self.readouts[name].show_value(text if known else UNKNOWN_VALUE)

    def _show_conditions(self, state: State, *, known: bool) -> None:
        if known:
            closed = state.loop.closed
            self.phase.set_status(PHASES[state.phase], state.phase.value)
            self.loop.set_status(
                Level.ACTIVE if closed else Level.NEUTRAL, "loop closed" if closed else "loop open"
            )
        else:
            self.phase.set_status(Level.NEUTRAL, UNKNOWN_VALUE)
            self.loop.set_status(Level.NEUTRAL, f"loop {UNKNOWN_VALUE}")
        if not (known and has_frames(state)):
            self.light.set_status(Level.NEUTRAL, f"saturated {UNKNOWN_VALUE}")
            return
        saturated = state.illumination.saturated
        level = Level.GOOD if saturated < SATURATION_WARNING else Level.WARNING
        self.light.set_status(
            Level.ERROR if saturated >= SATURATION_ERROR else level, f"saturated {100 * saturated:.2f} %"
        )

    def _show_control(self, state: State, *, replay: bool, mine: bool) -> None:
        if replay:
            self.control.set_status(Level.NEUTRAL, "replay")
        elif not is_measured(state):
            self.control.set_status(Level.NEUTRAL, f"control {UNKNOWN_VALUE}")
        elif mine:
            self.control.set_status(Level.GOOD, "you have control")
        elif state.lease is not None:
            self.control.set_status(Level.WARNING, f"{state.lease.name[:12]} has control")
        else:
            self.control.set_status(Level.NEUTRAL, "nobody in control")


def _safety_button(action: QAction, text: str) -> QPushButton:
    """A button of the action; it keeps its own text and never hides."""
    button = QPushButton(text)
    button.setObjectName("stop")
    button.setAccessibleName(text)
    button.clicked.connect(action.trigger)

    def follow() -> None:
        button.setEnabled(action.isEnabled())
        button.setToolTip(action.toolTip())

    action.changed.connect(follow)
    follow()
    button.setMinimumHeight(40)
    return button


class FaultBanner(QWidget):
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
        self._pill = StatusIndicator(context.theme)
        self._pill.set_status(Level.ERROR, "FAULT")
        self._text = QLabel()
        self._text.setWordWrap(True)
        self._button = HoldButton("clear", context.theme)
        self._button.confirmed.connect(clear.trigger)
        clear.changed.connect(lambda: self._sync_action(clear))
        row = QHBoxLayout(self)
        row.setContentsMargins(8, 4, 8, 4)
        row.addWidget(self._pill)
        row.addWidget(self._text, 1)
        row.addWidget(self._button)
        self.hide()

    def _sync_action(self, clear: QAction) -> None:
        self._button.setEnabled(clear.isEnabled())
        self._button.setToolTip(clear.toolTip())

    def show_state(self, state: State) -> None:
        """Appear or go."""
        fault = state.fault
        if fault is not None:
            text = f"{fault.reason} · {fault.at_utc}"
            self._text.setText(f"{text}\n{fault.remedy}" if fault.remedy else text)
        # Shown before it has its words it would take another height for a moment.
        self.setVisible(fault is not None)
