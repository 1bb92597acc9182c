"""Procedures: arguments, plan, start, progress, result."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, ClassVar

from numpy.typing import NDArray
from PySide6.QtCore import QSignalBlocker, QTimer, QUrl
from PySide6.QtGui import QDesktopServices, QResizeEvent
from PySide6.QtWidgets import QComboBox, QGridLayout, QLabel, QProgressBar, QPushButton, QWidget

from escape_gui.client.availability import (
    reason_no_abort,
    reason_no_engine,
    reason_no_pause,
    reason_no_request,
    reason_no_start,
)
from escape_gui.panels.base import Context, Panel
from escape_gui.views import procedure_form as form_text
from escape_gui.views.mode_maps import ModeStatistics
from escape_gui.widgets.argument_form import ArgumentForm
from escape_gui.widgets.controls import (
    QUALITY_LEVELS,
    Level,
    fit_height,
    row,
    scroll_area,
    set_available,
    text_label,
)
from escape_gui.widgets.inputs import ignore_wheel_without_focus
from escape_hw.remote.run import RemoteRun
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import Arguments, FinishedRun, Phase, ProcedureEntry, ProcedurePlan, State
from escape_hw.report.verdict import assess

#: Delay between the last edit and the request for a plan.
_PLAN_DELAY_MS = 400
REPLAY_TEXT = "Replay of a recorded run: no procedure can be started. The result of the run is shown below."
NO_SERVER_TEXT = "No server connected. Start one with 'escape serve SYSTEM', or open a recorded run (File)."


class ProcedurePanel(Panel):
    """Form, plan, four buttons, progress, and the last result."""

    name = "procedure"
    title = "Procedure"
    help = (
        "Calibrations, loops, optical gains and tracking. Choose a procedure and set its arguments; the plan "
        "below the form gives the number of frames, the time and the largest poke. Start, Pause and Abort "
        "act immediately."
    )
    streams: ClassVar[tuple[str, ...]] = ("matrix", "matrix_sigma")
    rate_hz = 5.0

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        #: Procedures that the present source offers, and those in the form.
        self._offered: tuple[ProcedureEntry, ...] = ()
        self._entries: dict[str, ProcedureEntry] = {}
        #: What the operator entered, by procedure and argument, and the procedure chosen last.
        self._entered: dict[str, dict[str, str]] = {}
        self._last_chosen = ""
        #: The arguments have to be checked as soon as the engine can.
        self._plan_is_due = False
        #: Number of the requested run, 0 before the server's answer; ``None``: no request is pending.
        self._requested_run: int | None = None
        self._plan: ProcedurePlan | None = None
        self._plan_level = "muted"
        self._checked_arguments: Arguments | None = None
        self._state = State()
        self._ended: FinishedRun | None = None
        self._documents: dict[str, Mapping[str, Any]] = {}
        #: System whose results are shown, and whether they are not those of a recorded run.
        self._bench = ("", True)
        self._matrix: dict[str, NDArray[Any]] = {}
        self._make_form()
        self._make_buttons()
        self._make_result()
        self._timer = QTimer(self)
        self._timer.setSingleShot(True)
        self._timer.setInterval(_PLAN_DELAY_MS)
        self._timer.timeout.connect(self._ask_due_plan)
        self.setFocusProxy(self.choice)
        self.apply_theme()

    # ------------------------------------------------------------ construction
    def _make_form(self) -> None:
        self.choice = QComboBox()
        self.choice.setAccessibleName("Procedure")
        ignore_wheel_without_focus(self.choice)
        self.choice.currentIndexChanged.connect(self._on_procedure_selected)
        self._description = text_label()
        self.form = ArgumentForm(self.choice)
        self.form.edited.connect(self._on_edit)
        self.plan = text_label()
        self.plan.setAccessibleName("Plan")
        for widget, stretch in ((self.choice, 0), (self._description, 0), (self.form, 100), (self.plan, 0)):
            self.body.addWidget(widget, stretch)

    def _make_buttons(self) -> None:
        self.check, self.start = QPushButton("&Check"), QPushButton("&Start")
        self.pause, self.abort = QPushButton("Pause"), QPushButton("Abort")
        self.abort.setObjectName("stop")
        session = self.context.session
        handlers: tuple[tuple[QPushButton, Callable[[], None]], ...] = (
            (self.check, self.ask_plan), (self.start, self.ask_start),
            (self.pause, session.toggle_pause), (self.abort, session.abort),
        )  # fmt: skip
        for button, ask in handlers:
            button.clicked.connect(lambda _=False, ask=ask: ask())
        self.body.addLayout(row(*(button for button, _ in handlers)))
        self.bar = QProgressBar()
        self.bar.setTextVisible(False)
        self.bar.setFixedHeight(8)
        self.progress, self._metrics = text_label(), text_label()
        for widget in (self.progress, self.bar, self._metrics):
            self.body.addWidget(widget)
        for label in (self._description, self.plan, self.progress, self._metrics):
            label.hide()

    def _make_result(self) -> None:
        result = QWidget()
        grid = QGridLayout(result)
        grid.setContentsMargins(0, 0, 0, 0)
        self.outcome, self.verdict, self.numbers = text_label(), text_label(), text_label()
        self._verdict_level = Level.NEUTRAL
        self._result_width = 0
        self.report, self.folder = QPushButton("Open report"), QPushButton("Open folder")
        self.report.clicked.connect(lambda: self._open(self._product("report")))
        self.folder.clicked.connect(lambda: self._open(self._ended.folder if self._ended else ""))
        grid.addWidget(self.outcome, 0, 0, 1, 3)
        grid.addWidget(self.verdict, 1, 0, 1, 3)
        grid.addWidget(self.numbers, 2, 0, 1, 3)
        grid.addWidget(self.report, 3, 0)
        grid.addWidget(self.folder, 3, 1)
        grid.setColumnStretch(2, 1)
        grid.setRowStretch(4, 1)
        self._result_area = scroll_area(result)
        self.body.addWidget(self._result_area, 100)
        self.body.addStretch(1)
        self._result_area.hide()

    # ------------------------------------------------------------ data
    def tick(self, source: DataSource) -> None:
        procedures = tuple(source.procedures())
        if procedures != self._offered:
            self._offered = procedures
            if procedures and procedures != tuple(self._entries.values()):
                self._show_procedures(procedures)
        self.form.setVisible(bool(procedures))
        self.choice.setVisible(bool(procedures))
        if (text := self._describe(source)) != self._description.text():
            _set_text(self._description, text)
        if self._plan_is_due and not self._timer.isActive() and not self._reason_no_plan():
            self._timer.start()
        self._enable()

    def _show_procedures(self, procedures: Sequence[ProcedureEntry]) -> None:
        """Offer other procedures; the one chosen last stays chosen if it is one of them."""
        self._entries = {one.name: one for one in procedures}
        blocker = QSignalBlocker(self.choice)
        self.choice.clear()
        for one in procedures:
            self.choice.addItem(one.title, one.name)
        self.choice.setCurrentIndex(max(0, self.choice.findData(self._last_chosen)))
        self._last_chosen = self._last_chosen or self.chosen
        blocker.unblock()
        self._show_form()

    def on_state(self, state: State) -> None:
        self._state = state
        self.form.set_matrix_choices(form_text.matrices(state.products))
        running = state.active_run
        if running is None:
            self._matrix.clear()
        share = 0.0 if running is None or not running.total else running.completed / running.total
        self.bar.setVisible(running is not None)
        self.bar.setRange(0, 1000 if running is None or running.total else 0)
        self.bar.setValue(round(1000 * min(1.0, share)))
        _set_text(self.progress, "" if running is None else form_text.progress_line(running))
        _set_text(self._metrics, "" if running is None else self._metrics_text(running.metrics))
        self.pause.setText("Resume" if running is not None and running.paused else "Pause")
        if state.last_run is not None and (self._ended is None or state.last_run.id != self._ended.id):
            self._show_ended(state.last_run)
        # Hidden during a run, to leave more room for the form.
        self._result_area.setVisible(self._ended is not None and running is None)
        if self.numbers.width() != self._result_width:
            # The width is known some time after they were shown.
            self._result_width = self.numbers.width()
            for label in (self.outcome, self.verdict, self.numbers):
                fit_height(label)

    def on_sample(self, stream: str, sample: Sample) -> None:
        self._matrix[stream] = sample.data

    def _metrics_text(self, metrics: Mapping[str, float]) -> str:
        data, worst = self._matrix.get("matrix"), ""
        if data is not None:
            worst = form_text.worst_mode(ModeStatistics.of(data, self._matrix.get("matrix_sigma")).snr)
        return " · ".join(one for one in (worst, form_text.metrics_line(metrics)) if one)

    def _show_ended(self, ended: FinishedRun) -> None:
        before = self._documents.get(ended.name)
        self._ended = ended
        if ended.document:
            self._documents[ended.name] = ended.document
        _set_text(self.outcome, form_text.result_line(ended))
        verdict = assess(ended.document)
        self._verdict_level = Level.NEUTRAL if verdict is None else QUALITY_LEVELS[verdict.quality]
        _set_text(self.verdict, "" if verdict is None else str(verdict))
        self._apply_verdict_colour()
        _set_text(self.numbers, "\n".join(form_text.comparison_lines(ended.document, before)))
        self.report.setVisible(bool(self._product("report")))
        self.folder.setVisible(bool(ended.folder))

    def _product(self, name: str) -> str:
        return self._ended.products.get(name, "") if self._ended is not None else ""

    def clear(self) -> None:
        """Discard the results of another bench; the form keeps what was entered, and is checked again."""
        session = self.context.session
        bench = (session.source.state.system, session.live)
        if bench[0] and bench != self._bench:
            self._bench, self._ended = bench, None
            self._documents.clear()
            self._result_area.hide()
        self._requested_run = None
        self._matrix.clear()
        self._on_edit()

    # ------------------------------------------------------------ form
    @property
    def chosen(self) -> str:
        return str(self.choice.currentData() or "")

    def _on_procedure_selected(self) -> None:
        self._last_chosen = self.chosen
        self._show_form()

    def _show_form(self) -> None:
        entry = self._entries.get(self.chosen)
        self.form.show_parameters(
            entry.parameters if entry else (),
            form_text.matrices(self._state.products),
            self._entered.setdefault(self.chosen, {}),
        )
        self._on_edit()

    def _describe(self, source: DataSource) -> str:
        """Help of the procedure and what is not valid on this server, or why there is no procedure."""
        if self._offered:
            entry = self._entries.get(self.chosen)
            parts = ("" if entry is None else entry.help, form_text.rejected_line(self.form.rejected))
            return "\n".join(part for part in parts if part)
        if not source.connected:
            return NO_SERVER_TEXT
        return REPLAY_TEXT if self.context.session.control is None else ""

    def _on_edit(self) -> None:
        self._plan = self._checked_arguments = None
        self._show_plan("")
        self._enable()
        self._plan_is_due = True
        # Once more after every edit.
        self._timer.stop()
        if self.chosen and not self._reason_no_plan():
            self._timer.start()

    def _reason_no_plan(self) -> str:
        """Why the arguments cannot be checked."""
        now = self.context.session.request_context
        starting = "the engine is starting" if now.state.phase is Phase.STARTING else ""
        return reason_no_engine(now) or starting or ("" if self._offered else "no procedures yet")

    def _show_plan(self, text: str, level: str = "muted") -> None:
        _set_text(self.plan, text)
        self._plan_level = level
        self._apply_plan_colour()

    def _apply_plan_colour(self) -> None:
        self.plan.setStyleSheet(f"color: {self.context.theme.colour(self._plan_level).name()};")

    def _apply_verdict_colour(self) -> None:
        self.verdict.setStyleSheet(f"color: {self.context.theme.colour(self._verdict_level.value).name()};")

    # ------------------------------------------------------------ requests
    def _ask_due_plan(self) -> None:
        if not self._reason_no_plan():
            self.ask_plan()

    def ask_plan(self) -> None:
        """Request the plan for the arguments in the form; nothing moves."""
        session, name = self.context.session, self.chosen
        self._plan_is_due = False
        if session.control is None or not name:
            return
        try:
            arguments = self.form.arguments()
        except ValueError as error:
            self._show_plan(f"⚠ {error}", "bad")
            return
        self._checked_arguments = arguments
        session.ask(
            "check the arguments",
            lambda server: server.plan(name, arguments),
            lambda plan: self._on_plan(name, arguments, plan),
            lambda why: self._show_plan(f"⚠ {why}", "bad"),
            quiet=True,
        )

    def _on_plan(self, name: str, arguments: Arguments, plan: ProcedurePlan) -> None:
        if name != self.chosen or arguments is not self._checked_arguments:
            return
        self._plan = plan
        warnings = [f"⚠ {one}" for one in plan.warnings]
        lines = form_text.plan_lines(plan, simulated=self._state.simulated)
        self._show_plan("\n".join([*lines, *warnings]), "warn" if warnings else "text")
        self._enable()

    def ask_start(self) -> None:
        session, name, arguments = self.context.session, self.chosen, self._checked_arguments
        if session.control is not None and self._plan is not None and arguments is not None:
            # A disabled button passes its focus on to the next widget, whatever it is.
            self.choice.setFocus()
            self._requested_run = 0
            session.ask(
                f"start {self.choice.currentText()}",
                lambda server: server.start(name, **arguments),
                self._on_started,
                lambda _: self._on_start_failed(),
            )
            self._enable()

    def _on_started(self, run: RemoteRun) -> None:
        self._requested_run = run.id
        self._enable()

    def _on_start_failed(self) -> None:
        self._requested_run = None
        self._enable()

    def _start_is_pending(self, state: State) -> bool:
        """Whether neither the server's answer nor a state with the requested run has arrived."""
        if self._requested_run:
            newest = max((one.id for one in (state.active_run, state.last_run) if one is not None), default=0)
            if newest >= self._requested_run:
                self._requested_run = None
        return self._requested_run is not None

    def _enable(self) -> None:
        now = self.context.session.request_context
        busy = "a procedure is running" if now.state.active_run is not None else ""
        busy = busy or ("it is being started" if self._start_is_pending(now.state) else "")
        not_checked = "" if self._plan is not None else "the arguments are not checked yet"
        for button, tip, reason in (
            (self.check, "Check the arguments and show the plan; nothing moves.", reason_no_engine(now)),
            (self.start, "Start the procedure.", reason_no_start(now) or busy or not_checked),
            (self.pause, "Pause between two steps, or resume.", reason_no_pause(now)),
            (self.abort, "Stop and save the data acquired so far.", reason_no_abort(now)),
        ):
            set_available(button, tip, reason)
        writable = not reason_no_request(now)
        self.form.setEnabled(writable)
        self.choice.setEnabled(writable and self.choice.count() > 0)

    def _open(self, path: str) -> None:
        if path and Path(path).exists():
            QDesktopServices.openUrl(QUrl.fromLocalFile(path))

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        for label in (self._description, self.plan, self.progress, self._metrics):
            fit_height(label)

    def apply_theme(self) -> None:
        theme = self.context.theme
        for label in (self.progress, self._metrics, self.numbers):
            label.setFont(theme.font(0.95, mono=True))
        self._description.setStyleSheet(f"color: {theme.colour('muted').name()};")
        self.verdict.setFont(theme.font(bold=True))
        self._apply_plan_colour()
        self._apply_verdict_colour()


def _set_text(label: QLabel, text: str) -> None:
    """Set the text of a label, and hide the label if it is empty."""
    label.setText(text)
    label.setVisible(bool(text))
    fit_height(label)
