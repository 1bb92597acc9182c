"""The loop's parameters: edit, check, apply; and closing it."""

from __future__ import annotations

from typing import ClassVar

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QComboBox,
    QDoubleSpinBox,
    QGridLayout,
    QHBoxLayout,
    QLabel,
    QPushButton,
    QSpinBox,
)

from escape_gui.client.availability import RequestContext, is_measured, reason_no_write
from escape_gui.panels.base import Context, Panel
from escape_gui.views.loop_form import FIELDS, LoopSettingsEdit
from escape_gui.widgets.controls.hold_button import HoldButton
from escape_gui.widgets.controls.status_indicator import Level, StatusIndicator
from escape_hw.config.system import MAX_GAIN
from escape_hw.remote.source import DataSource
from escape_hw.remote.state import LoopState, Phase, State

_TIPS = {
    "matrix": "Interaction matrix that the reconstructor is made of",
    "gain": "Share of the measured residual that is corrected in each frame",
    "leak": "Share of the command that is forgotten in each frame",
    "dropped_modes": "Highest modes that are left alone",
}


#: What stands here while no server was heard of, and in a recording.
NO_SERVER_TEXT = (
    "There is no loop to close here: only a server has one.\nStart it with 'escape serve SYSTEM'."
)


class LoopPanel(Panel):
    """Current values beside the wanted ones."""

    name: ClassVar[str] = "loop"
    title: ClassVar[str] = "Loop"
    help: ClassVar[str] = (
        "Edit the right column, press Check to see what would change, then Apply; nothing moves before "
        "that, and a closed loop changes without a bump. Hold the button to close the loop. Open loop is "
        "always at the top."
    )
    placeholder: ClassVar[str] = (
        "The engine is not ready.\nIt opens the devices first; see the log if it takes long."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.loop_indicator = StatusIndicator(theme, "closed")
        self.modes = QLabel()
        self.modes.setObjectName("caption")
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
        self.revert_button = QPushButton("As it is")
        self.revert_button.setToolTip("Take the current values into the form again")
        self.message = QLabel()
        self.message.setWordWrap(True)
        self.close_button = HoldButton("close the loop", theme)
        self._loop = LoopState()
        self._matrices: list[str] = []
        self._is_edited = False
        self._checked_edit: LoopSettingsEdit | None = None
        self._build_layout()
        self._connect_signals()
        self.apply_theme()

    def _build_layout(self) -> None:
        head = QHBoxLayout()
        head.addWidget(self.loop_indicator)
        head.addWidget(self.modes)
        head.addStretch()
        form = QGridLayout()
        form.setHorizontalSpacing(12)
        form.setVerticalSpacing(6)
        for column, text in ((1, "now"), (2, "wanted")):
            label = QLabel(text)
            label.setObjectName("caption")
            form.addWidget(label, 0, column)
        for row, (name, words) in enumerate(FIELDS.items(), 1):
            caption = QLabel(words)
            caption.setBuddy(self.editors[name])
            form.addWidget(caption, 2 * row, 0)
            # Names of matrices are long: the choice stands below.
            wide = name == "matrix"
            form.addWidget(self.current[name], 2 * row, 1, 1, 2 if wide else 1)
            form.addWidget(self.editors[name], 2 * row + wide, 1 if wide else 2, 1, 2 if wide else 1)
            self.editors[name].setToolTip(_TIPS[name])
            self.editors[name].setAccessibleName(f"{words} wanted")
        form.setColumnStretch(2, 1)
        form.setColumnStretch(3, 1)
        buttons = QHBoxLayout()
        for button in (self.check_button, self.apply_button, self.revert_button):
            buttons.addWidget(button)
        buttons.addStretch()
        self.body.addLayout(head)
        self.body.addLayout(form)
        self.body.addLayout(buttons)
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

    # ------------------------------------------------------------ news
    def on_state(self, state: State) -> None:
        """Current values; the form follows them until it is edited."""
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
        matrices = [product.name for product in state.products if product.kind == "matrix"]
        if matrices != self._matrices:
            self._set_matrix_choices(matrices, {product.name: product.summary for product in state.products})
        if not self._is_edited:
            self._revert()

    def _set_matrix_choices(self, matrices: list[str], summaries: dict[str, str]) -> None:
        wanted = self.matrix.currentText()
        self._matrices = matrices
        self.matrix.clear()
        self.matrix.addItems(matrices)
        for k, name in enumerate(matrices):
            self.matrix.setItemData(k, summaries[name], Qt.ItemDataRole.ToolTipRole)
        if self._is_edited and wanted in matrices:
            self.matrix.setCurrentText(wanted)
        else:
            # The newest is what one has just calibrated for.
            self.matrix.setCurrentIndex(len(matrices) - 1)

    def tick(self, source: DataSource) -> None:
        """Buttons are possible or say why not."""
        session = self.context.session
        now = RequestContext(source.state, source.connected, session.live, session.may_write)
        why = reason_no_write(now)
        _set_enabled(
            self.apply_button,
            why or ("" if self._checked_edit else "press Check first"),
            "Change the loop now",
        )
        if self._loop.closed:
            reason = "it is closed"
        elif not self._matrices:
            reason = "there is no interaction matrix yet: calibrate, or load one"
        elif source.state.active_run is not None:
            reason = f"{source.state.active_run.name} runs"
        else:
            reason = ""
        _set_enabled(self.close_button, why or reason, "Close the loop with the values of the right column")

    # ------------------------------------------------------------ edit, check, apply
    @property
    def edit(self) -> LoopSettingsEdit:
        """What stands in the form."""
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
        self._is_edited, self._checked_edit = False, None
        self.message.setText("")

    def check(self) -> None:
        """Say what would change, or what is wrong."""
        edit = self.edit
        validation_errors = edit.validation_errors(self._loop)
        self._checked_edit = None if validation_errors or not edit.changed(self._loop) else edit
        self.message.setText(
            "\n".join(validation_errors)
            if validation_errors
            else f"Apply: {edit.describe_changes(self._loop)}"
        )

    def apply(self) -> None:
        """Change what was checked."""
        requests, edit = self.context.session.requests, self._checked_edit
        if requests is None or edit is None:
            return
        changed = edit.changed(self._loop)
        self.message.setText("Applying…")
        requests.ask(
            "change the loop", lambda server: server.set_loop(**changed), self._applied, self._refused
        )

    def close_loop(self) -> None:
        """Close the loop with what stands in the form."""
        requests, edit = self.context.session.requests, self.edit
        if requests is None:
            return
        if validation_errors := edit.validation_errors(self._loop):
            self.message.setText("\n".join(validation_errors))
            return
        self.message.setText("Closing the loop…")
        requests.ask(
            "close the loop",
            lambda server: server.close_loop(edit.matrix, edit.gain or None, edit.leak, edit.dropped_modes),
            self._applied,
            self._refused,
        )

    def _applied(self, _: object) -> None:
        self._is_edited, self._checked_edit = False, None
        self.message.setText("Done.")

    def _refused(self, reason: str) -> None:
        self._checked_edit = None
        self.message.setText(reason)

    def clear(self) -> None:
        """Another source: nothing is edited."""
        self._is_edited, self._checked_edit = False, None
        self.message.setText("")

    def apply_theme(self) -> None:
        """Numbers stand in columns."""
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


def _set_enabled(button: QPushButton, why_not: str, tip: str) -> None:
    button.setEnabled(not why_not)
    button.setToolTip(tip if not why_not else f"Not now: {why_not}.")
