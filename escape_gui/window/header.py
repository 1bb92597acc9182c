"""Header of the window: connection banner, system state, safety buttons, fault banner."""

from __future__ import annotations

import time
from collections.abc import Sequence

from PySide6.QtCore import QEvent, QObject, QSize, Qt
from PySide6.QtGui import QAction, QResizeEvent
from PySide6.QtWidgets import (
    QApplication,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QWidget,
)

from escape_gui.client.availability import UNKNOWN_VALUE, has_engine, has_frames, is_measured
from escape_gui.client.connection import CLIENT_NAME
from escape_gui.panels.base import Context
from escape_gui.widgets.controls import HoldButton, Level, Readout, StatusIndicator, column, row, text_label
from escape_hw.io.provenance import format_local_time
from escape_hw.remote.state import Phase, State

PHASES: dict[Phase, Level] = {
    Phase.STARTING: Level.ACTIVE, Phase.IDLE: Level.GOOD, Phase.LOOP: Level.ACTIVE,
    Phase.PROCEDURE: Level.ACTIVE, Phase.FAULT: Level.ERROR, Phase.STOPPED: Level.NEUTRAL,
}  # fmt: skip
#: Fraction of saturated pixels from which the indicator shows a warning and an error.
SATURATION_WARNING, SATURATION_ERROR = 0.001, 0.01
#: Banner before the first connection.
NOT_CONNECTED_TEXT = (
    "NOT CONNECTED · start a server with 'escape serve SYSTEM', or open a recorded run (File)"
)


class ConnectionBanner(QLabel):
    """Banner over the full width with the word SIMULATED, HARDWARE, REPLAY or NOT CONNECTED."""

    def __init__(self, context: Context) -> None:
        super().__init__()
        self._context = context
        self._palette_keys: tuple[str, str] = ("stop", "on_stop")
        self.setAlignment(Qt.AlignmentFlag.AlignCenter)
        context.theme.changed.connect(self._apply_theme)
        self.show_state(State(), connected=False, live=True)

    def show_state(self, state: State, *, connected: bool, live: bool) -> None:
        """Show the kind of source and the name of the system."""
        system = f"{state.system} · seed {state.seed}" if state.simulated else state.system
        if not connected and not is_measured(state):
            text, keys = NOT_CONNECTED_TEXT, ("button", "text")
        elif not live:
            text, keys = f"REPLAY OF A RECORDED RUN · {state.system} · NOT THE BENCH", ("replay", "on_replay")
        elif not connected:
            text, keys = "NOT CONNECTED · values below are stale", ("stop", "on_stop")
        elif state.simulated:
            text, keys = f"SIMULATED · {system}", ("simulated", "on_simulated")
        else:
            text, keys = f"HARDWARE · {system}", ("hardware", "on_hardware")
        if (text, keys) != (self.text(), self._palette_keys):
            self._palette_keys = keys
            self.setText(text)
            self._apply_theme()

    def _apply_theme(self) -> None:
        colours = self._context.theme.colours
        back, front = (getattr(colours, name) for name in self._palette_keys)
        self.setFont(self._context.theme.font(bold=True))
        self.setStyleSheet(f"background: {back}; color: {front}; padding: 3px;")


class _Conditions(QWidget):
    """Pairs of widgets above each other; the last pairs are hidden where they have no room.

    The safety buttons beside them stay visible at any width.
    """

    _SPACING_PX = 24

    def __init__(self, pairs: Sequence[tuple[QWidget, QWidget]]) -> None:
        super().__init__()
        self._columns = []
        for pair in pairs:
            page = QWidget()
            right = isinstance(pair[0], Readout)
            column(*(row(None, one) if right else one for one in pair), parent=page, spacing=0)
            self._columns.append(page)
        row(*self._columns, None, parent=self, spacing=self._SPACING_PX)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Preferred)

    def minimumSizeHint(self) -> QSize:
        return QSize(0, super().minimumSizeHint().height())

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        used = 0
        for one in self._columns:
            used += one.sizeHint().width()
            one.setVisible(used <= self.width())
            used += self._SPACING_PX


class HeaderBar(QWidget):
    """Connection banner, state of the system in two rows, and the safety buttons."""

    def __init__(self, context: Context, open_loop: QAction, flatten: QAction) -> None:
        super().__init__()
        theme = context.theme
        self.connection_banner = ConnectionBanner(context)
        self.phase = StatusIndicator(theme, "procedure")
        self.loop = StatusIndicator(theme, "loop closed")
        self.saturation = StatusIndicator(theme, "saturated 0.00 %")
        self.control = StatusIndicator(theme, "no operator connected")
        self.readouts = {
            "rate": Readout(theme, "frame rate", "Hz", 6),
            "lost": Readout(theme, "lost", "frames", 6),
            "rms": Readout(theme, "mirror rms", "stroke", 5),
            "peak": Readout(theme, "peak", "stroke", 5),
            "latency": Readout(theme, "latency p99", "µs", 5),
            "jitter": Readout(theme, "jitter p99", "µs", 5),
        }
        self.open_button = _safety_button(open_loop, "Open loop")
        self.flatten_button = _safety_button(flatten, "FLATTEN")
        column(self.connection_banner, self._row(), parent=self, spacing=0)

    def _row(self) -> QHBoxLayout:
        pairs: tuple[tuple[QWidget, QWidget], ...] = (
            (self.phase, self.loop), (self.saturation, self.control),
            (self.readouts["rate"], self.readouts["lost"]), (self.readouts["rms"], self.readouts["peak"]),
            (self.readouts["latency"], self.readouts["jitter"]),
        )  # fmt: skip
        self.conditions = _Conditions(pairs)
        content = row((self.conditions, 1), self.open_button, self.flatten_button)
        content.setContentsMargins(8, 4, 8, 4)
        return content

    def show_state(self, state: State, *, connected: bool, live: bool, mine: bool) -> None:
        """Update everything; ``mine``: this client holds the lease."""
        self.connection_banner.show_state(state, connected=connected, live=live)
        known = live and is_measured(state)
        for button in (self.open_button, self.flatten_button):
            button.setVisible(live)
        self._show_conditions(state, known=known)
        self._show_control(state, replay=connected and not live, mine=mine)
        latency = state.latency
        values = {
            "rate": f"{state.rates.frame_hz:.1f}",
            "lost": f"{state.rates.lost_frames:d}",
            "rms": f"{state.mirror.rms:.3f}",
            "peak": f"{state.mirror.peak:.3f}",
            # Zero if no command was sent in the last second.
            "latency": f"{latency.p99:.0f}" if latency.p99 else UNKNOWN_VALUE,
            "jitter": f"{latency.jitter_p99:.0f}" if latency.p99 else UNKNOWN_VALUE,
        }
        self.readouts["rate"].set_name("simulated rate" if known and state.simulated else "frame rate")
        for name, text in values.items():
            self.readouts[name].show_value(text if known and has_engine(state) else UNKNOWN_VALUE)

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
            self.saturation.set_status(Level.NEUTRAL, f"saturated {UNKNOWN_VALUE}")
            return
        saturated = state.illumination.saturated
        level = Level.GOOD if saturated < SATURATION_WARNING else Level.WARNING
        self.saturation.set_status(
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
            name = "another window" if state.lease.name == CLIENT_NAME else state.lease.name[:12]
            self.control.set_status(Level.WARNING, f"{name} has control")
        else:
            self.control.set_status(Level.NEUTRAL, "no operator connected")


def _safety_button(action: QAction, text: str) -> QPushButton:
    """A button that triggers an action but keeps its own text and is always visible."""
    button = _action_button(text, action)
    button.setObjectName("stop")
    button.setAccessibleName(text)
    button.setMinimumHeight(40)
    return button


def _action_button(text: str, action: QAction) -> QPushButton:
    """A button that triggers an action."""
    button = QPushButton(text)
    button.clicked.connect(action.trigger)
    _follow_action(button, action)
    return button


def _follow_action(button: QPushButton, action: QAction) -> None:
    """Enable a button and explain it as its action."""

    def synchronise() -> None:
        button.setEnabled(action.isEnabled())
        button.setToolTip(action.toolTip())

    action.changed.connect(synchronise)
    synchronise()


#: Interval of the sound of an alarm, seconds.
_SOUND_PERIOD_S = 2.0
#: Silence of the client in control from which the window offers to take over; several heartbeats, seconds.
_SILENCE_S = 3.0


def control_offer(state: State) -> str:
    """Why control is offered: nobody has it, or its holder is silent; empty if somebody has it."""
    lease, run = state.lease, state.active_run
    if lease is not None:
        if lease.silent_s < _SILENCE_S:
            return ""
        return (
            f"{lease.name} on {lease.host} has not responded for {lease.silent_s:.0f} s and loses control in "
            f"{lease.expires_in_s:.0f} s"
        )
    if run is None:
        return f"No operator has control{'; the loop stays closed' if state.loop.closed else ''}"
    text = f"No operator has control; '{run.name}' (run {run.id})"
    if not state.unattended_limit_s:
        return f"{text} goes on"
    return f"{text} is aborted in {max(0.0, state.unattended_limit_s - state.unattended_for_s):.0f} s"


class Banner(QWidget):
    """A row below the header with a word, a text and a button; visible while there is a text."""

    def __init__(self, context: Context, level: Level, word: str, button: QPushButton) -> None:
        super().__init__()
        indicator = StatusIndicator(context.theme)
        indicator.set_status(level, word)
        self.text, self.button = text_label(), button
        row(indicator, (self.text, 1), button, parent=self).setContentsMargins(8, 4, 8, 4)
        self.hide()

    def show_text(self, text: str) -> None:
        """Show the row, or hide it if the text is empty."""
        if text != self.text.text():
            self.text.setText(text)
        # After the text was set: the height depends on it.
        self.setVisible(bool(text))


class BannerStack(QScrollArea):
    """Banners above each other, the most severe first; they scroll where they would displace the panels."""

    #: Most of the window's height for more than the first banner.
    _MOST = 1 / 6

    def __init__(self, banners: Sequence[Banner]) -> None:
        super().__init__()
        self._banners = banners
        self.setWidgetResizable(True)
        self.setFrameShape(QScrollArea.Shape.NoFrame)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        content = QWidget()
        column(*banners, parent=content, spacing=0)
        self.setWidget(content)
        content.installEventFilter(self)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        # A banner was shown or hidden, or its text has changed.
        if event.type() == QEvent.Type.LayoutRequest:
            self.fit()
        return super().eventFilter(watched, event)

    def fit(self) -> None:
        """Take the height of the visible banners, or as much as the window has for them."""
        width = self.viewport().width()
        heights = [
            max(one.heightForWidth(width), one.sizeHint().height())
            for one in self._banners
            if not one.isHidden()
        ]
        wanted = (
            min(sum(heights), max(round(self._MOST * self.window().height()), heights[0])) if heights else 0
        )
        if wanted != self.height():
            self.setFixedHeight(wanted)
            # Without this, a click before the next event loop misses the button.
            content, layout = self.widget(), self.window().layout()
            if layout is not None:
                layout.activate()
            if content is not None:
                content.resize(width, max(sum(heights), wanted))


class ControlBanner(Banner):
    """Offers control with a button while nobody uses it."""

    def __init__(self, context: Context, take_control: QAction) -> None:
        super().__init__(context, Level.WARNING, "CONTROL", _action_button("Take control", take_control))

    def show_state(self, state: State, *, offered: bool) -> None:
        """Show or hide the row; ``offered``: this window can take control and does not have it."""
        self.show_text(control_offer(state) if offered and is_measured(state) else "")


class AlarmBanner(Banner):
    """Shows alarms until they are acknowledged, with a sound every few seconds."""

    def __init__(self, context: Context, acknowledge: QAction) -> None:
        super().__init__(context, Level.ERROR, "ALARM", _action_button("Acknowledge", acknowledge))
        self._sounded_s = 0.0

    def show_alarms(self, texts: Sequence[str], *, muted: bool) -> None:
        """Show the texts of alarms, if there are any."""
        self.show_text("\n".join(texts))
        now = time.monotonic()
        if texts and not muted and now - self._sounded_s > _SOUND_PERIOD_S:
            self._sounded_s = now
            QApplication.beep()


class FrozenBanner(Banner):
    """Shows that the panels do not follow the data."""

    def __init__(self, context: Context, freeze: QAction) -> None:
        super().__init__(context, Level.WARNING, "FROZEN", _action_button("Resume (X)", freeze))

    def show_frozen(self, since: str) -> None:
        """Show the time since when the panels are frozen; empty: they are not."""
        self.show_text(f"The panels show the data of {since}. The rows above are live." if since else "")


class ServerBanner(Banner):
    """Shows that the window is connected to a server while a recorded run is on screen."""

    def __init__(self, context: Context) -> None:
        super().__init__(context, Level.ACTIVE, "SERVER", QPushButton("Leave the replay"))
        self.button.setToolTip("Close the recorded run and show the server.")


class FaultBanner(Banner):
    """Shows a fault, with a button for the action that clears it."""

    def __init__(self, context: Context, clear: QAction) -> None:
        button = HoldButton("clear", context.theme)
        button.confirmed.connect(clear.trigger)
        _follow_action(button, clear)
        super().__init__(context, Level.ERROR, "FAULT", button)

    def show_state(self, state: State) -> None:
        """Show the fault, or hide the row if there is none."""
        fault = state.fault
        if fault is None:
            self.show_text("")
            return
        text = f"{format_local_time(fault.at_utc)} {fault.reason}"
        self.show_text(f"{text}\n{fault.remedy}" if fault.remedy else text)
