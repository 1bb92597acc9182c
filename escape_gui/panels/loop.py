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

from escape_gui.loop_form import FIELDS, LoopEdit
from escape_gui.panels.panel import Context, Panel
from escape_gui.situation import Situation, is_measured, to_write
from escape_gui.widgets.hold_button import HoldButton
from escape_gui.widgets.status_pill import Level, StatusPill
from escape_hw.config.models import GAIN_MOST
from escape_hw.remote.source import Source
from escape_hw.remote.state import LoopState, Phase, State

_TIPS = {
    "matrix": "Interaction matrix that the reconstructor is made of",
    "gain": "Share of the measured residual that is corrected in each frame",
    "leak": "Share of the command that is forgotten in each frame",
    "dropped_modes": "Highest modes that are left alone",
}


#: What stands here while no server was heard of, and in a recording.
NOBODY = "There is no loop to close here: only a server has one.\nStart it with 'escape serve SYSTEM'."


class LoopPanel(Panel):
    """Current values beside the wanted ones."""

    name: ClassVar[str] = "loop"
    title: ClassVar[str] = "Loop"
    help: ClassVar[str] = (
        "Edit the right column, press Check to see what would change, then Apply; nothing moves before "
        "that, and a closed loop changes without a bump. Hold the button to close the loop. Open loop is "
        "always at the top."
    )
    empty: ClassVar[str] = (
        "The engine is not ready.\nIt opens the devices first; see the log if it takes long."
    )

    def __init__(self, context: Context) -> None:
        super().__init__(context)
        theme = context.theme
        self.pill = StatusPill(theme, "closed")
        self.modes = QLabel()
        self.modes.setObjectName("caption")
        self.matrix = QComboBox()
        self.gain = _spin(0.0, GAIN_MOST, 0.05, 4)
        self.leak = _spin(0.0, 1.0, 0.005, 4)
        self.dropped_modes = QSpinBox()
        self.dropped_modes.setRange(0, 10000)
        self.editors = {
            "matrix": self.matrix, "gain": self.gain, "leak": self.leak, "dropped_modes": self.dropped_modes,
        }  # fmt: skip
        self.current = {name: QLabel("–") for name in FIELDS}
        self.check_button = QPushButton("Check")
        self.apply_button = QPushButton("Apply")
        self.reset_button = QPushButton("As it is")
        self.reset_button.setToolTip("Take the current values into the form again")
        self.message = QLabel()
        self.message.setWordWrap(True)
        self.close_button = HoldButton("close the loop", theme)
        self._loop = LoopState()
        self._matrices: list[str] = []
        self._edited = False
        self._checked: LoopEdit | None = None
        self._lay_out()
        self._connect()
        self.restyle()

    def _lay_out(self) -> None:
        head = QHBoxLayout()
        head.addWidget(self.pill)
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
        for button in (self.check_button, self.apply_button, self.reset_button):
            buttons.addWidget(button)
        buttons.addStretch()
        self.body.addLayout(head)
        self.body.addLayout(form)
        self.body.addLayout(buttons)
        self.body.addWidget(self.message)
        self.body.addStretch()
        self.body.addWidget(self.close_button)

    def _connect(self) -> None:
        self.matrix.activated.connect(self._edit)
        for spin in (self.gain, self.leak, self.dropped_modes):
            spin.valueChanged.connect(self._edit)
        self.check_button.clicked.connect(self.check)
        self.apply_button.clicked.connect(self.apply)
        self.reset_button.clicked.connect(self._take_current)
        self.close_button.held.connect(self.close_loop)

    # ------------------------------------------------------------ news
    def take_state(self, state: State) -> None:
        """Current values; the form follows them until it is edited."""
        self._loop = loop = state.loop
        self.set_empty(state.phase in (Phase.STARTING, Phase.STOPPED), None if is_measured(state) else NOBODY)
        self.pill.show_condition(
            Level.ACTIVE if loop.closed else Level.QUIET, "closed" if loop.closed else "open"
        )
        self.modes.setText(f"{loop.modes} modes controlled" if loop.modes else "")
        values = {
            "matrix": loop.matrix or "none", "gain": f"{loop.gain:.4f}", "leak": f"{loop.leak:.4f}",
            "dropped_modes": str(loop.dropped_modes),
        }  # fmt: skip
        for name, text in values.items():
            self.current[name].setText(text)
        matrices = [product.name for product in state.products if product.kind == "matrix"]
        if matrices != self._matrices:
            self._offer(matrices, {product.name: product.summary for product in state.products})
        if not self._edited:
            self._take_current()

    def _offer(self, matrices: list[str], summaries: dict[str, str]) -> None:
        wanted = self.matrix.currentText()
        self._matrices = matrices
        self.matrix.clear()
        self.matrix.addItems(matrices)
        for k, name in enumerate(matrices):
            self.matrix.setItemData(k, summaries[name], Qt.ItemDataRole.ToolTipRole)
        if self._edited and wanted in matrices:
            self.matrix.setCurrentText(wanted)
        else:
            # The newest is what one has just calibrated for.
            self.matrix.setCurrentIndex(len(matrices) - 1)

    def tick(self, source: Source) -> None:
        """Buttons are possible or say why not."""
        session = self.context.session
        now = Situation(source.state, source.connected, session.live, session.may_write)
        why = to_write(now)
        _allow(
            self.apply_button, why or ("" if self._checked else "press Check first"), "Change the loop now"
        )
        if self._loop.closed:
            reason = "it is closed"
        elif not self._matrices:
            reason = "there is no interaction matrix yet: calibrate, or load one"
        elif source.state.procedure is not None:
            reason = f"{source.state.procedure.name} runs"
        else:
            reason = ""
        _allow(self.close_button, why or reason, "Close the loop with the values of the right column")

    # ------------------------------------------------------------ edit, check, apply
    @property
    def edit(self) -> LoopEdit:
        """What stands in the form."""
        return LoopEdit(
            self.matrix.currentText(), round(self.gain.value(), 6), round(self.leak.value(), 6),
            self.dropped_modes.value(),
        )  # fmt: skip

    def _edit(self) -> None:
        self._edited, self._checked = True, None
        self.message.setText("Edited; press Check.")

    def _take_current(self) -> None:
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
        self._edited, self._checked = False, None
        self.message.setText("")

    def check(self) -> None:
        """Say what would change, or what is wrong."""
        edit = self.edit
        problems = edit.problems(self._loop)
        self._checked = None if problems or not edit.changed(self._loop) else edit
        self.message.setText("\n".join(problems) if problems else f"Apply: {edit.in_words(self._loop)}")

    def apply(self) -> None:
        """Change what was checked."""
        commands, edit = self.context.session.commands, self._checked
        if commands is None or edit is None:
            return
        changed = edit.changed(self._loop)
        self.message.setText("Applying…")
        commands.ask(
            "change the loop", lambda server: server.set_loop(**changed), self._applied, self._refused
        )

    def close_loop(self) -> None:
        """Close the loop with what stands in the form."""
        commands, edit = self.context.session.commands, self.edit
        if commands is None:
            return
        if problems := edit.problems(self._loop):
            self.message.setText("\n".join(problems))
            return
        self.message.setText("Closing the loop…")
        commands.ask(
            "close the loop",
            lambda server: server.close_loop(edit.matrix, edit.gain or None, edit.leak, edit.dropped_modes),
            self._applied,
            self._refused,
        )

    def _applied(self, _: object) -> None:
        self._edited, self._checked = False, None
        self.message.setText("Done.")

    def _refused(self, reason: str) -> None:
        self._checked = None
        self.message.setText(reason)

    def clear(self) -> None:
        """Another source: nothing is edited."""
        self._edited, self._checked = False, None
        self.message.setText("")

    def restyle(self) -> None:
        """Numbers stand in columns."""
        mono = self.context.theme.font(mono=True)
        for label in self.current.values():
            label.setFont(mono)
        for name, editor in self.editors.items():
            wide = name == "matrix"
            editor.setMaximumWidth(self.context.theme.pixels(360 if wide else 180))
            if not wide:
                editor.setFont(mono)


def _spin(low: float, high: float, step: float, digits: int) -> QDoubleSpinBox:
    spin = QDoubleSpinBox()
    spin.setRange(low, high)
    spin.setSingleStep(step)
    spin.setDecimals(digits)
    spin.setKeyboardTracking(False)
    return spin


def _allow(button: QPushButton, why_not: str, tip: str) -> None:
    button.setEnabled(not why_not)
    button.setToolTip(tip if not why_not else f"Not now: {why_not}.")
