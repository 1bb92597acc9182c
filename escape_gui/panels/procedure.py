"""Choose a procedure, see what it would do, start it, watch it, stop it, and read what came of it."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, ClassVar

from numpy.typing import NDArray
from PySide6.QtCore import Qt, QTimer, QUrl
from PySide6.QtGui import QDesktopServices, QResizeEvent
from PySide6.QtWidgets import (
    QComboBox,
    QFrame,
    QGridLayout,
    QHBoxLayout,
    QLabel,
    QProgressBar,
    QPushButton,
    QScrollArea,
    QWidget,
)

from escape_gui.panels.panel import Context, Panel
from escape_gui.situation import Situation, to_abort, to_ask, to_pause, to_write
from escape_gui.views import procedure_form as words
from escape_gui.views.mode_mosaic import ModeStatistics
from escape_gui.widgets.argument_form import ArgumentForm
from escape_hw.remote.source import Sample, Source
from escape_hw.remote.state import Arguments, Ended, Plan, ProcedureEntry, State

#: Wait so long after the last edit before the server is asked what the procedure would do.
_SETTLED_MS = 400
#: What stands in the form of a recording.
NOTHING = "This is a recording: it can be looked at, nothing can be started. Its result stands below."

NOBODY = "No server has answered. Start one with 'escape serve SYSTEM', or open a recording (File)."


class ProcedurePanel(Panel):
    """The form, the plan, four buttons, progress, and the last result."""

    name = "procedure"
    title = "Procedure"
    help = (
        "Calibrations, loops, optical gains and tracking. Choose one and set its arguments; the plan below "
        "says what it would take and how far the mirror would move. Start, Pause and Abort act at once."
    )
    streams: ClassVar[tuple[str, ...]] = ("matrix", "matrix_sigma")
    rate_hz = 5.0

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        self._entries: dict[str, ProcedureEntry] = {}
        self._plan: Plan | None = None
        self._plan_level = "muted"
        self._checking: Arguments | None = None
        self._state = State()
        self._ended: Ended | None = None
        self._documents: dict[str, Mapping[str, Any]] = {}
        self._matrix: dict[str, NDArray[Any]] = {}
        self._make_form()
        self._make_buttons()
        self._make_result()
        self._timer = QTimer(self)
        self._timer.setSingleShot(True)
        self._timer.setInterval(_SETTLED_MS)
        self._timer.timeout.connect(self.ask_plan)
        self.setFocusProxy(self.choice)
        self.restyle()

    # ------------------------------------------------------------ building
    def _make_form(self) -> None:
        self.choice = QComboBox()
        self.choice.setAccessibleName("Procedure")
        self.choice.currentIndexChanged.connect(self._choose)
        self._about = _words()
        self.form = ArgumentForm(self.context.theme)
        self.form.edited.connect(self._edit)
        self.plan = _words()
        self.plan.setAccessibleName("Plan")
        for widget, stretch in ((self.choice, 0), (self._about, 0), (self.form, 100), (self.plan, 0)):
            self.body.addWidget(widget, stretch)

    def _make_buttons(self) -> None:
        self.check, self.start = QPushButton("&Check"), QPushButton("&Start")
        self.pause, self.abort = QPushButton("Pause"), QPushButton("Abort")
        self.abort.setObjectName("stop")
        row = QHBoxLayout()
        asked: tuple[tuple[QPushButton, Callable[[], None]], ...] = (
            (self.check, self.ask_plan), (self.start, self.ask_start),
            (self.pause, self.ask_pause), (self.abort, self.ask_abort),
        )  # fmt: skip
        for button, ask in asked:
            button.clicked.connect(lambda _=False, ask=ask: ask())
            row.addWidget(button)
        self.body.addLayout(row)
        self.bar = QProgressBar()
        self.bar.setTextVisible(False)
        self.bar.setFixedHeight(8)
        self.progress, self._metrics = _words(), _words()
        for widget in (self.progress, self.bar, self._metrics):
            self.body.addWidget(widget)

    def _make_result(self) -> None:
        self._result = QWidget()
        grid = QGridLayout(self._result)
        grid.setContentsMargins(0, 0, 0, 0)
        self.outcome, self.numbers = _words(), _words()
        self.report, self.folder = QPushButton("Open report"), QPushButton("Open folder")
        self.report.clicked.connect(lambda: self._open(self._product("report")))
        self.folder.clicked.connect(lambda: self._open(self._ended.folder if self._ended else ""))
        grid.addWidget(self.outcome, 0, 0, 1, 3)
        grid.addWidget(self.numbers, 1, 0, 1, 3)
        grid.addWidget(self.report, 2, 0)
        grid.addWidget(self.folder, 2, 1)
        grid.setColumnStretch(2, 1)
        grid.setRowStretch(3, 1)
        self._outcome = QScrollArea()
        self._outcome.setWidgetResizable(True)
        self._outcome.setFrameShape(QFrame.Shape.NoFrame)
        self._outcome.setWidget(self._result)
        self.body.addWidget(self._outcome, 100)
        self.body.addStretch(1)
        self._outcome.hide()

    # ------------------------------------------------------------ data
    def tick(self, source: Source) -> None:
        """Once the server says what it offers, make the list."""
        if not self._entries and source.connected and (found := source.procedures()):
            self._entries = {one.name: one for one in found}
            for one in found:
                self.choice.addItem(one.title, one.name)
            self._choose()
        self.form.setVisible(bool(self._entries))
        if not self._entries:
            replay = source.connected and self.context.session.commands is None
            _put(self._about, NOTHING if replay else "" if source.connected else NOBODY)
        self._enable()

    def take_state(self, state: State) -> None:
        """Progress, products to choose from, and how the last one ended."""
        self._state = state
        self.form.offer_matrices(words.matrices(state.products))
        running = state.procedure
        if running is None:
            self._matrix.clear()
        share = 0.0 if running is None or not running.total else running.done / running.total
        self.bar.setVisible(running is not None)
        self.bar.setRange(0, 1000 if running is None or running.total else 0)
        self.bar.setValue(round(1000 * min(1.0, share)))
        _put(self.progress, "" if running is None else words.progress_line(running))
        _put(self._metrics, "" if running is None else self._watched(running.metrics))
        self.pause.setText("Go on" if running is not None and running.paused else "Pause")
        # While something runs, what came of the last one only takes its room.
        self._outcome.setVisible(self._ended is not None and running is None)
        if state.last is not None and (self._ended is None or state.last.id != self._ended.id):
            self._show_ended(state.last)

    def take_sample(self, stream: str, sample: Sample) -> None:
        """The matrix that is being measured tells which mode is known worst."""
        self._matrix[stream] = sample.data

    def _watched(self, metrics: Mapping[str, float]) -> str:
        data, worst = self._matrix.get("matrix"), ""
        if data is not None:
            worst = words.worst_mode(ModeStatistics.of(data, self._matrix.get("matrix_sigma")).snr)
        return " · ".join(one for one in (worst, words.metrics_line(metrics)) if one)

    def _show_ended(self, ended: Ended) -> None:
        before = self._documents.get(ended.name)
        self._ended = ended
        if ended.document:
            self._documents[ended.name] = ended.document
        _put(self.outcome, words.ended_line(ended))
        _put(self.numbers, "\n".join(words.comparison_lines(ended.document, before)))
        self.report.setVisible(bool(self._product("report")))
        self.folder.setVisible(bool(ended.folder))
        self._outcome.show()

    def _product(self, name: str) -> str:
        return self._ended.products.get(name, "") if self._ended is not None else ""

    def clear(self) -> None:
        """Forget what another server offered."""
        self._entries, self._plan, self._ended = {}, None, None
        self._documents.clear()
        self._matrix.clear()
        self.choice.clear()
        self._outcome.hide()

    # ------------------------------------------------------------ form
    @property
    def chosen(self) -> str:
        """Name of the chosen procedure."""
        return str(self.choice.currentData() or "")

    def _choose(self) -> None:
        entry = self._entries.get(self.chosen)
        _put(self._about, entry.help if entry else "")
        self.form.show_parameters(entry.parameters if entry else (), words.matrices(self._state.products))
        self._edit()

    def _edit(self) -> None:
        self._plan = None
        self._say_plan("")
        self._enable()
        if self.chosen and self.context.session.commands is not None:
            self._timer.start()

    def _say_plan(self, text: str, level: str = "muted") -> None:
        _put(self.plan, text)
        self._plan_level = level
        self._colour_plan()

    def _colour_plan(self) -> None:
        self.plan.setStyleSheet(f"color: {self.context.theme.colour(self._plan_level).name()};")

    # ------------------------------------------------------------ requests
    def ask_plan(self) -> None:
        """Ask what the procedure would do; nothing moves."""
        commands, name = self.context.session.commands, self.chosen
        if commands is None or not name:
            return
        try:
            arguments = self.form.arguments()
        except ValueError as error:
            self._say_plan(f"⚠ {error}", "bad")
            return
        self._checking = arguments
        commands.ask(
            "check the arguments",
            lambda server: server.check(name, arguments),
            lambda plan: self._take_plan(name, arguments, plan),
            lambda why: self._say_plan(f"⚠ {why}", "bad"),
            quiet=True,
        )

    def _take_plan(self, name: str, arguments: Arguments, plan: Plan) -> None:
        if name != self.chosen or arguments is not self._checking:
            return
        self._plan = plan
        warnings = [f"⚠ {one}" for one in plan.warnings]
        self._say_plan("\n".join([*words.plan_lines(plan), *warnings]), "warn" if warnings else "text")
        self._enable()

    def ask_start(self) -> None:
        """Start what was planned."""
        commands, name, arguments = self.context.session.commands, self.chosen, self._checking
        if commands is not None and self._plan is not None and arguments is not None:
            self.start.setEnabled(False)
            commands.ask(f"start {self.choice.currentText()}", lambda server: server.start(name, **arguments))

    def ask_pause(self) -> None:
        """Halt, or go on."""
        commands, running = self.context.session.commands, self._state.procedure
        if commands is not None and running is not None:
            paused = running.paused
            commands.ask(
                "go on" if paused else "pause", lambda server: server.resume() if paused else server.pause()
            )

    def ask_abort(self) -> None:
        """Stop; what was measured is kept."""
        commands = self.context.session.commands
        if commands is not None:
            commands.ask("abort the procedure", lambda server: server.abort(), urgent=True)

    def _enable(self) -> None:
        """Buttons that are of no use now say why."""
        session = self.context.session
        source = session.source
        now = Situation(source.state, source.connected, session.live, session.may_write)
        busy = "a procedure runs" if now.state.procedure is not None else ""
        unplanned = "" if self._plan is not None else "the arguments are not checked yet"
        for button, tip, why in (
            (self.check, "Ask what it would do; nothing moves.", to_ask(now)),
            (self.start, "Start it.", to_write(now) or busy or unplanned),
            (self.pause, "Halt between two steps, or go on.", to_pause(now)),
            (self.abort, "Stop; what was measured is kept.", to_abort(now)),
        ):
            button.setEnabled(not why)
            button.setToolTip(tip if not why else f"{tip} Not now: {why}.")
        writable = not to_ask(now)
        self.form.setEnabled(writable)
        self.choice.setEnabled(writable and self.choice.count() > 0)

    def _open(self, path: str) -> None:
        if path and Path(path).exists():
            QDesktopServices.openUrl(QUrl.fromLocalFile(path))

    def resizeEvent(self, event: QResizeEvent) -> None:
        """Words wrap anew."""
        super().resizeEvent(event)
        for label in (self._about, self.plan, self.progress, self._metrics):
            _fit(label)

    def restyle(self) -> None:
        """Numbers in letters that do not jitter."""
        theme = self.context.theme
        for label in (self.progress, self._metrics, self.numbers):
            label.setFont(theme.font(0.95, mono=True))
        self._about.setStyleSheet(f"color: {theme.colour('muted').name()};")
        self._colour_plan()


def _put(label: QLabel, text: str) -> None:
    """Words that take no room while there are none."""
    label.setText(text)
    label.setVisible(bool(text))
    _fit(label)


def _fit(label: QLabel) -> None:
    """Lines that wrap ask for their height only where somebody gives it to them."""
    label.setMinimumHeight(max(0, label.heightForWidth(label.width())) if label.text() else 0)


def _words() -> QLabel:
    """A line of words that wraps and can be copied."""
    label = QLabel()
    label.setWordWrap(True)
    label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    label.setVisible(False)
    return label
