"""Parameters of the loop: edit, check, apply; and closing the loop."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar

from PySide6.QtCore import Qt
from PySide6.QtWidgets import QComboBox, QDoubleSpinBox, QGridLayout, QLabel, QPushButton, QSpinBox

from escape_gui.client.availability import is_measured, reason_no_write
from escape_gui.panels.base import Context, Panel
from escape_gui.views.loop_form import FIELDS, LoopSettingsEdit
from escape_gui.widgets.controls import (
    HoldButton,
    Level,
    StatusIndicator,
    caption,
    row,
    set_available,
    text_label,
)
from escape_hw.config.system import MAX_GAIN
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
        self.matrix = QComboBox()
        self.gain = _spin_box(0.0, MAX_GAIN, 0.05, 4)
        self.leak = _spin_box(0.0, 1.0, 0.005, 4)
        self.dropped_modes = QSpinBox()
        self.dropped_modes.setRange(0, 10000)
        self.editors = {
            "matrix": self.matrix, "gain": self.gain, "leak": self.leak, "dropped_modes": self.dropped_modes,
        }  # fmt: skip
        self.current = {name: QLabel("–") for name in FIELDS}
        self.check_button = QPushButton("Check")
        self.apply_button = QPushButton("Apply")
        self.revert_button = QPushButton("Revert")
        self.revert_button.setToolTip("Revert the form to the current values")
        self.message = text_label()
        self.close_button = HoldButton("close the loop", theme)
        self._loop = LoopState()
        self._matrices: list[str] = []
        self._is_edited = False
        self._checked_edit: LoopSettingsEdit | None = None
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
            form.addWidget(self.current[name], 2 * line, 1, 1, 2 if wide else 1)
            form.addWidget(self.editors[name], 2 * line + wide, 1 if wide else 2, 1, 2 if wide else 1)
            self.editors[name].setToolTip(_TIPS[name])
            self.editors[name].setAccessibleName(f"{text} setpoint")
        form.setColumnStretch(2, 1)
        form.setColumnStretch(3, 1)
        self.body.addLayout(row(self.loop_indicator, self.modes, None))
        self.body.addLayout(form)
        self.body.addLayout(row(self.check_button, self.apply_button, self.revert_button, None))
        self.body.addWidget(self.message)
        self.body.addStretch()
        self.body.addWidget(self.close_button)

    def _connect_signals(self) -> None:
        self.matrix.activated.connect(self._on_edit)
        for spin in (self.gain, self.leak, self.dropped_modes):
            spin.valueChanged.connect(self._on_edit)
        self.check_button.clicked.connect(self.check)
        self.apply_button.clicked.connect(self.apply)
        self.revert_button.clicked.connect(self._revert)
        self.close_button.confirmed.connect(self.close_loop)

    # ------------------------------------------------------------ data
    def on_state(self, state: State) -> None:
        """Show the current values; the form follows them until it is edited."""
        self._loop = loop = state.loop
        self.show_placeholder(
            state.phase in (Phase.STARTING, Phase.STOPPED), None if is_measured(state) else NO_SERVER_TEXT
        )
        self.loop_indicator.set_status(
            Level.ACTIVE if loop.closed else Level.NEUTRAL, "closed" if loop.closed else "open"
        )
        self.modes.setText(f"{loop.n_modes} modes controlled" if loop.n_modes else "")
        values = {
            "matrix": loop.matrix or "none", "gain": f"{loop.gain:.4f}", "leak": f"{loop.leak:.4f}",
            "dropped_modes": str(loop.dropped_modes),
        }  # fmt: skip
        for name, text in values.items():
            self.current[name].setText(text)
        summaries = {product.name: product.summary for product in state.products if product.kind == "matrix"}
        if list(summaries) != self._matrices:
            self._set_matrix_choices(summaries)
        if not self._is_edited:
            self._revert()

    def _set_matrix_choices(self, summaries: dict[str, str]) -> None:
        selected = self.matrix.currentText()
        self._matrices = list(summaries)
        self.matrix.clear()
        for k, (name, summary) in enumerate(summaries.items()):
            self.matrix.addItem(name)
            self.matrix.setItemData(k, summary, Qt.ItemDataRole.ToolTipRole)
        if self._is_edited and selected in summaries:
            self.matrix.setCurrentText(selected)
        else:
            self.matrix.setCurrentIndex(len(summaries) - 1)  # the newest

    def tick(self, source: DataSource) -> None:
        now = self.context.session.request_context
        reason = reason_no_write(now)
        not_checked = "" if self._checked_edit else "press Check first"
        set_available(self.apply_button, "Change the loop now.", reason or not_checked)
        if self._loop.closed:
            obstacle = "the loop is closed"
        elif not self._matrices:
            obstacle = "there is no interaction matrix yet: calibrate, or load one"
        elif now.state.active_run is not None:
            obstacle = f"{now.state.active_run.name} is running"
        else:
            obstacle = ""
        set_available(self.close_button, "Close the loop with the setpoints.", reason or obstacle)

    # ------------------------------------------------------------ edit, check, apply
    @property
    def edit(self) -> LoopSettingsEdit:
        return LoopSettingsEdit(
            self.matrix.currentText(), round(self.gain.value(), 6), round(self.leak.value(), 6),
            self.dropped_modes.value(),
        )  # fmt: skip

    def _on_edit(self) -> None:
        self._is_edited, self._checked_edit = True, None
        self.message.setText("Edited; press Check.")

    def _revert(self) -> None:
        loop = self._loop
        for widget in self.editors.values():
            widget.blockSignals(True)
        if loop.matrix in self._matrices:
            self.matrix.setCurrentText(loop.matrix)
        self.gain.setValue(loop.gain)
        self.leak.setValue(loop.leak)
        self.dropped_modes.setValue(loop.dropped_modes)
        for widget in self.editors.values():
            widget.blockSignals(False)
        self.clear()

    def check(self) -> None:
        """Show the changes, or what is invalid."""
        edit = self.edit
        errors = edit.validation_errors(self._loop)
        self._checked_edit = None if errors or not edit.changed(self._loop) else edit
        self.message.setText("\n".join(errors) or f"Apply: {edit.describe_changes(self._loop)}")

    def apply(self) -> None:
        if self._checked_edit is not None:
            changed = self._checked_edit.changed(self._loop)
            self._ask("change the loop", lambda server: server.set_loop(**changed))

    def close_loop(self) -> None:
        edit = self.edit
        if errors := edit.validation_errors(self._loop):
            self.message.setText("\n".join(errors))
            return
        self._ask(
            "close the loop",
            lambda server: server.close_loop(edit.matrix, edit.gain or None, edit.leak, edit.dropped_modes),
        )

    def _ask(self, what: str, call: Callable[[Connection], object]) -> None:
        if self.context.session.control is not None:
            self.message.setText("Waiting for the server…")
            self.context.session.ask(what, call, self._on_done, self._on_refused)

    def _on_done(self, _: object) -> None:
        self.clear()
        self.message.setText("Done.")

    def _on_refused(self, reason: str) -> None:
        self._checked_edit = None
        self.message.setText(reason)

    def clear(self) -> None:
        self._is_edited, self._checked_edit = False, None
        self.message.setText("")

    def apply_theme(self) -> None:
        mono = self.context.theme.font(mono=True)
        for label in self.current.values():
            label.setFont(mono)
        for name, editor in self.editors.items():
            wide = name == "matrix"
            editor.setMaximumWidth(self.context.theme.pixels(360 if wide else 180))
            if not wide:
                editor.setFont(mono)


def _spin_box(low: float, high: float, step: float, digits: int) -> QDoubleSpinBox:
    spin = QDoubleSpinBox()
    spin.setRange(low, high)
    spin.setSingleStep(step)
    spin.setDecimals(digits)
    spin.setKeyboardTracking(False)
    return spin
