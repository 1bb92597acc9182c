"""Parameters of the loop: edit, check, apply; and closing the loop."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import ClassVar

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QGridLayout, QLabel, QPushButton, QWidget

from escape_gui.client.availability import (
    UNKNOWN_VALUE,
    has_ended,
    is_measured,
    reason_no_change,
    reason_no_start,
)
from escape_gui.panels.base import Context, Panel
from escape_gui.views.loop_form import FIELDS, LIMITS, LoopSettingsEdit
from escape_gui.widgets.controls import (
    ElidedLabel,
    HoldButton,
    Level,
    StatusIndicator,
    caption,
    row,
    set_available,
    text_label,
)
from escape_gui.widgets.inputs import NameSelector, NumberBox
from escape_hw.remote.client import Connection
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import LoopState, Phase, State

_TIPS = {
    "matrix": "Interaction matrix from which the reconstructor is computed",
    "gain": "Fraction of the measured residual that is corrected in each frame",
    "leak": "Leak of the integrator per frame",
    "dropped_modes": "Number of highest-order modes not controlled",
}
#: Placeholder without a server, and in a recorded run.
NO_SERVER_TEXT = "No loop available: no server connected.\nStart one with 'escape serve SYSTEM'."


class LoopPanel(Panel):
    """Current values of the loop parameters, and a form for their setpoints."""

    name: ClassVar[str] = "loop"
    title: ClassVar[str] = "Loop"
    help: ClassVar[str] = (
        "Edit the setpoints in the right column, press Check to see the changes, then Apply; nothing changes "
        "before that, and a closed loop changes without a jump of the command. Hold the button to close the "
        "loop. Open loop is always at the top."
    )
    placeholder: ClassVar[str] = (
        "The engine is not ready.\nIt opens the devices first; see the log if this takes long."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.loop_indicator = StatusIndicator(theme, "closed")
        self.modes = caption()
        self.matrix = NameSelector()
        self.load_button = QPushButton("Load…")
        self.load_button.setToolTip("Load the matrix of another run, also of an earlier night, or of a file")
        self.gain = NumberBox(*LIMITS["gain"], step=0.05, decimals=4)
        self.leak = NumberBox(*LIMITS["leak"], step=0.005, decimals=4)
        self.dropped_modes = NumberBox(*LIMITS["dropped_modes"], step=1, decimals=0)
        self.numbers = {"gain": self.gain, "leak": self.leak, "dropped_modes": self.dropped_modes}
        self.editors: dict[str, QWidget] = {"matrix": self.matrix, **self.numbers}
        #: Its name may be long.
        self.current_matrix = ElidedLabel("–")
        self.current = {name: QLabel("–") for name in self.numbers}
        self.check_button = QPushButton("Check")
        self.apply_button = QPushButton("Apply")
        self.revert_button = QPushButton("Revert")
        self.revert_button.setToolTip("Revert the form to the current values")
        self.message = text_label()
        #: Values with which the button closes the loop.
        self.closing_values = text_label()
        self.close_button = HoldButton("close the loop", theme)
        self._loop = LoopState()
        self._matrices: list[str] = []
        #: Fields that do not follow the state, since the operator changed them.
        self._edited: set[str] = set()
        #: Matrix that the operator chose, also while it is not listed, and the system of the edits.
        self._chosen_matrix = self._system = ""
        self._checked_edit: LoopSettingsEdit | None = None
        self._message_colour = "text"
        self._build_layout()
        self._connect_signals()
        self.apply_theme()

    def _build_layout(self) -> None:
        form = QGridLayout()
        form.setHorizontalSpacing(12)
        form.setVerticalSpacing(6)
        for k, text in ((1, "Current"), (2, "Setpoint")):
            form.addWidget(caption(text), 0, k)
        for line, (name, text) in enumerate(FIELDS.items(), 1):
            label = QLabel(text)
            label.setBuddy(self.editors[name])
            form.addWidget(label, 2 * line, 0)
            # Names of matrices are long: their editor is in a line of its own.
            wide = name == "matrix"
            current = self.current_matrix if wide else self.current[name]
            form.addWidget(current, 2 * line, 1, 1, 2 if wide else 1)
            form.addWidget(self.editors[name], 2 * line + wide, 1 if wide else 2, 1, 2 if wide else 1)
            limits = f", {LIMITS[name][0]:g} to {LIMITS[name][1]:g}" if name in LIMITS else ""
            self.editors[name].setToolTip(f"{_TIPS[name]}{limits}")
            self.editors[name].setAccessibleName(f"{text} setpoint")
        form.addWidget(self.load_button, 3, 0, Qt.AlignmentFlag.AlignLeft)
        form.setColumnStretch(2, 1)
        form.setColumnStretch(3, 1)
        self.body.addLayout(row(self.loop_indicator, self.modes, None))
        self.body.addLayout(form)
        self.body.addLayout(row(self.check_button, self.apply_button, self.revert_button, None))
        self.body.addWidget(self.message)
        self.body.addStretch()
        self.body.addWidget(self.closing_values)
        self.body.addWidget(self.close_button)

    def _connect_signals(self) -> None:
        self.matrix.activated.connect(lambda _: self._on_edit("matrix"))
        for name, field in self.numbers.items():
            field.edited.connect(partial(self._on_edit, name))
            field.lineEdit().returnPressed.connect(self.check)
        self.check_button.clicked.connect(self.check)
        self.apply_button.clicked.connect(self.apply)
        self.revert_button.clicked.connect(self._revert)
        self.close_button.confirmed.connect(self.close_loop)

    # ------------------------------------------------------------ data
    def on_state(self, state: State) -> None:
        """Show the current values; a field of the form follows them until it is edited."""
        if self._loop.closed and not state.loop.closed and self._message_colour == "text":
            # "Loop closed with ..." is no longer so.
            self._show_message("")
        self._loop = loop = state.loop
        self.show_placeholder(
            state.phase in (Phase.STARTING, Phase.STOPPED), None if is_measured(state) else NO_SERVER_TEXT
        )
        self.loop_indicator.set_status(
            Level.ACTIVE if loop.closed else Level.NEUTRAL, "closed" if loop.closed else "open"
        )
        ended = has_ended(state)
        self.modes.setText(f"{loop.n_modes} modes controlled" if loop.n_modes and not ended else "")
        # Without an engine nothing is in use.
        self.current_matrix.show_text(UNKNOWN_VALUE if ended else loop.matrix or "none")
        values = {
            "gain": f"{loop.gain:.4f}", "leak": f"{loop.leak:.4f}", "dropped_modes": str(loop.dropped_modes),
        }  # fmt: skip
        for name, text in values.items():
            self.current[name].setText(UNKNOWN_VALUE if ended else text)
        summaries = {product.name: product.summary for product in state.products if product.kind == "matrix"}
        if list(summaries) != self._matrices:
            self._set_matrix_choices(summaries)
        self._follow_state()

    def _set_matrix_choices(self, summaries: dict[str, str]) -> None:
        self._matrices = list(summaries)
        self.matrix.clear()
        for k, (name, summary) in enumerate(summaries.items()):
            self.matrix.addItem(name)
            self.matrix.setItemData(k, summary, Qt.ItemDataRole.ToolTipRole)
        if "matrix" in self._edited and self._chosen_matrix in summaries:
            self.matrix.setCurrentText(self._chosen_matrix)
        else:
            self.matrix.setCurrentIndex(len(summaries) - 1)  # the newest

    def tick(self, source: DataSource) -> None:
        now = self.context.session.request_context
        reason = reason_no_change(now)
        edit = self._checked_edit
        nothing = "press Check first" if edit is None else "" if edit.changed(self._loop) else "no changes"
        set_available(self.apply_button, "Change the loop now.", reason or nothing)
        if self._loop.closed:
            obstacle = "the loop is closed"
        elif not self._matrices:
            obstacle = "there is no interaction matrix yet: calibrate, or load one"
        elif now.state.active_run is not None:
            obstacle = f"{now.state.active_run.name} is running"
        else:
            obstacle = "press Check first" if self._edited and self._checked_edit is None else ""
        obstacle = reason_no_start(now) or obstacle
        set_available(self.close_button, "Close the loop with the values above.", obstacle)
        self.closing_values.setText("" if obstacle else f"Closes with {self.edit.describe()}.")
        self.closing_values.setVisible(not obstacle)

    # ------------------------------------------------------------ edit, check, apply
    @property
    def edit(self) -> LoopSettingsEdit:
        """The values of the form."""
        return LoopSettingsEdit(
            self.matrix.currentText(), round(self.gain.value(), 6), round(self.leak.value(), 6),
            round(self.dropped_modes.value()),
        )  # fmt: skip

    def _on_edit(self, name: str) -> None:
        self._edited.add(name)
        self._chosen_matrix = self.matrix.currentText() if name == "matrix" else self._chosen_matrix
        self._checked_edit = None
        errors = self.edit.validation_errors(self._loop)
        self._show_message("\n".join(errors) or "Edited; press Check.", errors=bool(errors))

    def choose_matrix(self, name: str) -> None:
        """Choose a matrix that was loaded as the setpoint."""
        self.on_state(self.context.session.source.state)
        if name in self._matrices:
            self.matrix.setCurrentText(name)
            self._on_edit("matrix")

    def _follow_state(self) -> None:
        """Set the fields that the operator did not edit to the current values."""
        loop = self._loop
        if "matrix" not in self._edited and loop.matrix in self._matrices:
            self.matrix.setCurrentText(loop.matrix)
        for name in self.numbers.keys() - self._edited:
            self.numbers[name].setValue(getattr(loop, name))

    def _forget_edits(self) -> None:
        self._edited.clear()
        self._checked_edit = None
        self._show_message("")

    def _revert(self) -> None:
        self._forget_edits()
        self._follow_state()

    def check(self) -> None:
        """Show the changes, or what is invalid."""
        edit = self.edit
        errors = edit.validation_errors(self._loop)
        changed = edit.changed(self._loop)
        self._checked_edit = None if errors else edit
        if not errors and not changed:
            self._edited.clear()
        self._show_message(
            "\n".join(errors) or f"Checked: {edit.describe_changes(self._loop)}", errors=bool(errors)
        )

    def apply(self) -> None:
        """Send the checked changes."""
        if self._checked_edit is not None:
            changed = self._checked_edit.changed(self._loop)
            # The button is disabled next, and would pass its focus on to Revert.
            self.check_button.setFocus()
            done = f"Applied: {self._checked_edit.describe_changes(self._loop)}"
            self._ask("change the loop", lambda server: server.set_loop(**changed), self._checked_edit, done)

    def close_loop(self) -> None:
        """Close the loop with the values of the form, all of which are current or checked."""
        edit = self.edit
        # The button of a closed loop is disabled, and would pass its focus on to any widget.
        self.check_button.setFocus()
        self._ask(
            "close the loop",
            lambda server: server.close_loop(edit.matrix, edit.gain or None, edit.leak, edit.dropped_modes),
            edit,
            f"Loop closed with {edit.describe()}",
        )

    def _ask(
        self, what: str, call: Callable[[Connection], object], sent: LoopSettingsEdit, done: str
    ) -> None:
        if self.context.session.control is not None:
            self._show_message("Waiting for the server…")
            self.context.session.ask(what, call, lambda _: self._on_done(sent, done), self._on_refused)

    def _on_done(self, sent: LoopSettingsEdit, done: str) -> None:
        """Show the result; what was edited while the server worked stays."""
        now = self.edit
        self._edited = {name for name in self._edited if getattr(now, name) != getattr(sent, name)}
        if not self._edited:
            self._checked_edit = None
        self._show_message(f"{done}. Edited since; press Check." if self._edited else done)

    def _on_refused(self, reason: str) -> None:
        self._checked_edit = None
        self._show_message(reason, errors=True)

    def _show_message(self, text: str, *, errors: bool = False) -> None:
        """Show a message until the next edit or request."""
        self._message_colour = "bad" if errors else "text"
        self.message.setText(text)
        self.message.setVisible(bool(text))
        self._apply_message_colour()

    def _apply_message_colour(self) -> None:
        self.message.setStyleSheet(f"color: {self.context.theme.colour(self._message_colour).name()};")

    def clear(self) -> None:
        """Edited setpoints stay for the same system, after a crash of its engine or a reconnection.

        They have to be checked again.
        """
        system = self.context.session.source.state.system
        if system and system != self._system:
            self._system = system
            self._edited.clear()
        self._checked_edit = None
        self._show_message("Edited before; press Check." if self._edited else "")

    def apply_theme(self) -> None:
        mono = self.context.theme.font(mono=True)
        for label in (self.current_matrix, *self.current.values()):
            label.setFont(mono)
        for name, editor in self.editors.items():
            wide = name == "matrix"
            editor.setMaximumWidth(self.context.theme.pixels(360 if wide else 180))
            editor.setMinimumWidth(self.context.theme.pixels(110))
            if not wide:
                editor.setFont(mono)
        self._apply_message_colour()
