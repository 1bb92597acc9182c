"""The top of the window: what we are connected to, how it is, and the two buttons that make it safe."""

from __future__ import annotations

from PySide6.QtCore import Qt
from PySide6.QtGui import QAction
from PySide6.QtWidgets import QGridLayout, QHBoxLayout, QLabel, QPushButton, QVBoxLayout, QWidget

from escape_gui.panels.panel import Context
from escape_gui.situation import UNKNOWN, is_lit, is_measured
from escape_gui.widgets.readout import Readout
from escape_gui.widgets.status_pill import Level, StatusPill
from escape_hw.remote.state import Phase, State

PHASES: dict[Phase, Level] = {
    Phase.STARTING: Level.ACTIVE,
    Phase.IDLE: Level.GOOD,
    Phase.LOOP: Level.ACTIVE,
    Phase.PROCEDURE: Level.ACTIVE,
    Phase.FAULT: Level.BAD,
    Phase.STOPPED: Level.QUIET,
}
#: Share of saturated pixels from which the number is a warning, and from which it is bad.
SATURATED_WARN, SATURATED_BAD = 0.001, 0.01
#: What to do before a server was ever heard of.
NOWHERE = "NOT CONNECTED · start a server with 'escape serve SYSTEM', or open a recording (File)"


class Strip(QLabel):
    """The full-width band with the word SIMULATED, HARDWARE, REPLAY or NOT CONNECTED."""

    def __init__(self, context: Context) -> None:
        super().__init__()
        self._context = context
        self._looks: tuple[str, str] = ("stop", "on_stop")
        self.setAlignment(Qt.AlignmentFlag.AlignCenter)
        context.theme.changed.connect(self._restyle)
        self.show_state(State(), connected=False, live=True)

    def show_state(self, state: State, *, connected: bool, live: bool) -> None:
        """Say what we are connected to."""
        where = f"{state.system} · seed {state.seed}" if state.simulated else state.system
        if not connected and not is_measured(state):
            word, looks = NOWHERE, ("button", "text")
        elif not live:
            word, looks = f"REPLAY · {state.system}", ("button", "text")
        elif not connected:
            word, looks = "NOT CONNECTED · the numbers below are old", ("stop", "on_stop")
        elif state.simulated:
            word, looks = f"SIMULATED · {where}", ("simulated", "on_simulated")
        else:
            word, looks = f"HARDWARE · {where}", ("hardware", "on_hardware")
        if (word, looks) != (self.text(), self._looks):
            self._looks = looks
            self.setText(word)
            self._restyle()

    def _restyle(self) -> None:
        colours = self._context.theme.colours
        back, front = (getattr(colours, name) for name in self._looks)
        self.setFont(self._context.theme.font(bold=True))
        self.setStyleSheet(f"background: {back}; color: {front}; padding: 3px;")


class Band(QWidget):
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
        self.strip = Strip(context)
        self.phase = StatusPill(theme, "procedure")
        self.loop = StatusPill(theme, "loop closed")
        self.light = StatusPill(theme, "saturated 0.00 %")
        self.control = StatusPill(theme, "nobody in control")
        self.readouts = {
            "rate": Readout(theme, "frames", "Hz", 6),
            "lost": Readout(theme, "lost", "frames", 6),
            "rms": Readout(theme, "mirror rms", "stroke", 5),
            "peak": Readout(theme, "peak", "stroke", 5),
            "latency": Readout(theme, "latency p99", "µs", 5),
            "jitter": Readout(theme, "jitter p99", "µs", 5),
        }
        self.open_button = _safety(open_loop, "Open loop")
        self.flatten_button = _safety(flatten, "FLATTEN")
        column = QVBoxLayout(self)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(0)
        column.addWidget(self.strip)
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
        self.strip.show_state(state, connected=connected, live=live)
        known = live and is_measured(state)
        self._show_conditions(state, known=known)
        replay = connected and not live
        self._show_control(state, replay=replay, mine=mine)
        values = {
            "rate": f"{state.rates.frame_hz:.1f}",
            "lost": f"{state.rates.lost:d}",
            "rms": f"{state.mirror.rms:.3f}",
            "peak": f"{state.mirror.peak:.3f}",
            # Nothing was late where no frame was answered in the last second.
            "latency": f"{state.latency.p99:.0f}" if state.latency.p99 else UNKNOWN,
            "jitter": f"{state.latency.jitter_p99:.0f}" if state.latency.p99 else UNKNOWN,
        }
        for name, text in values.items():
            self.readouts[name].show_value(text if known else UNKNOWN)

    def _show_conditions(self, state: State, *, known: bool) -> None:
        if known:
            closed = state.loop.closed
            self.phase.show_condition(PHASES[state.phase], state.phase.value)
            self.loop.show_condition(
                Level.ACTIVE if closed else Level.QUIET, "loop closed" if closed else "loop open"
            )
        else:
            self.phase.show_condition(Level.QUIET, UNKNOWN)
            self.loop.show_condition(Level.QUIET, f"loop {UNKNOWN}")
        if not (known and is_lit(state)):
            self.light.show_condition(Level.QUIET, f"saturated {UNKNOWN}")
            return
        saturated = state.light.saturated
        level = Level.GOOD if saturated < SATURATED_WARN else Level.WARN
        self.light.show_condition(
            Level.BAD if saturated >= SATURATED_BAD else level, f"saturated {100 * saturated:.2f} %"
        )

    def _show_control(self, state: State, *, replay: bool, mine: bool) -> None:
        if replay:
            self.control.show_condition(Level.QUIET, "replay")
        elif not is_measured(state):
            self.control.show_condition(Level.QUIET, f"control {UNKNOWN}")
        elif mine:
            self.control.show_condition(Level.GOOD, "you have control")
        elif state.lease is not None:
            self.control.show_condition(Level.WARN, f"{state.lease.name[:12]} has control")
        else:
            self.control.show_condition(Level.QUIET, "nobody in control")


def _safety(action: QAction, text: str) -> QPushButton:
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
