"""Dialog with the offsets of mirror and loop: tip, tilt, focus, a mode, reference slopes, flat."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

from PySide6.QtWidgets import QComboBox, QDialog, QGridLayout, QLineEdit, QPushButton, QWidget

from escape_gui.client.availability import reason_no_start
from escape_gui.client.session import Session
from escape_gui.theme import Theme
from escape_gui.widgets.controls import caption, column, row, set_available, text_label
from escape_gui.widgets.inputs import NumberBox, ignore_wheel_without_focus
from escape_hw.remote.client import Connection
from escape_hw.remote.state import OffsetsState

TERMS = ("tip", "tilt", "focus")
_LIMIT_NM = 5000.0
_NOTE = (
    "Nanometres rms wavefront, added to the mirror at rest and to the shape that a closed loop converges to: "
    "non-common-path aberrations are corrected here."
)
#: Text and tooltip of every button.
_BUTTONS = {
    "apply": ("Apply", "Move the mirror at rest, and the shape that a closed loop converges to."),
    "zero": ("Clear all", "Set tip, tilt, focus and all modes to zero."),
    "present_slopes": ("Use present slopes", "Average the slopes for 2 s; the loop keeps them so."),
    "clear_slopes": ("Clear", "Use the reference slopes of the matrix."),
    "present_shape": ("Use present shape", "The present shape of the mirror becomes its flat."),
    "clear_flat": ("Clear", "Flat is a command of zeros."),
    "load": ("Restore", "Restore the saved offsets."),
    "save": ("Save", "Save the present offsets on the server."),
}


class OffsetsDialog(QDialog):
    """Edits the offsets. The server refuses those beyond the limits of the mirror."""

    def __init__(self, window: QWidget, session: Session, theme: Theme) -> None:
        super().__init__(window)
        self._session, self._theme = session, theme
        self._shown: OffsetsState | None = None
        #: Fields that were edited since they were applied.
        self._edited: set[str] = set()
        self.setWindowTitle("Offsets of mirror and loop")
        self.fields = {
            name: NumberBox(-_LIMIT_NM, _LIMIT_NM, step=5, decimals=1) for name in (*TERMS, "mode")
        }
        self.mode_number = NumberBox(1, 10_000, step=1, decimals=0)
        self.mode_number.setValue(4)
        self.mode_number.setAccessibleName("Number of the mode")
        self.mode_number.edited.connect(self._show_mode)
        self.current = {name: caption("0.0") for name in self.fields}
        self.references, self.flat = caption(), caption()
        self.saved, self.name = QComboBox(), QLineEdit()
        self.saved.setAccessibleName("Saved offsets")
        ignore_wheel_without_focus(self.saved)
        self.name.setPlaceholderText("name")
        self.name.setAccessibleName("Name under which the offsets are saved")
        self.name.textEdited.connect(lambda _: self.update_buttons())
        self.buttons = {name: QPushButton(text) for name, (text, _) in _BUTTONS.items()}
        close = QPushButton("Close")
        handlers: dict[str, Callable[[], object]] = {
            "apply": self.apply, "zero": self._clear_terms,
            "present_slopes": lambda: self._set(references="present"),
            "clear_slopes": lambda: self._set(references="clear"),
            "present_shape": lambda: self._set(flat="present"), "clear_flat": lambda: self._set(flat="clear"),
            "load": self._load, "save": self._save,
        }  # fmt: skip
        for name, button in (*self.buttons.items(), ("close", close)):
            button.setAutoDefault(False)
            button.clicked.connect(self.reject if name == "close" else handlers[name])
        self.message = text_label()
        note = text_label()
        note.setText(_NOTE)
        b = self.buttons
        column(
            note, self._make_grid(), row(b["apply"], b["zero"], None),
            row(self.references, None, b["present_slopes"], b["clear_slopes"]),
            row(self.flat, None, b["present_shape"], b["clear_flat"]),
            row((self.saved, 1), b["load"]), row((self.name, 1), b["save"]), self.message, row(None, close),
            parent=self,
        ).setContentsMargins(16, 16, 16, 16)  # fmt: skip
        theme.follow(self._apply_theme)

    def _make_grid(self) -> QGridLayout:
        """A line for each term: name, number of the mode, present value, setpoint, unit."""
        grid = QGridLayout()
        for k, text in ((2, "Current"), (3, "Setpoint")):
            grid.addWidget(caption(text), 0, k)
        for line, (name, field) in enumerate(self.fields.items(), 1):
            field.setAccessibleName(f"{name} setpoint")
            field.edited.connect(partial(self._edited.add, name))
            field.lineEdit().returnPressed.connect(self.apply)
            grid.addWidget(caption(name), line, 0)
            grid.addWidget(self.current[name], line, 2)
            grid.addWidget(field, line, 3)
            grid.addWidget(caption("nm rms"), line, 4)
        grid.addWidget(self.mode_number, len(self.fields), 1)
        return grid

    def open_offsets(self) -> None:
        """Show the present offsets."""
        self._show_message("")
        self._shown = None
        self.update_buttons()
        self._edited.clear()
        self._follow()
        self.show()
        self.raise_()
        self.fields["tip"].setFocus()

    # ------------------------------------------------------------ requests
    def apply(self) -> None:
        """Set the terms; other modes stay as they are."""
        for name, field in self.fields.items():
            if not field.low <= field.value() <= field.high:
                reason = f"{name} {field.value():g} is out of range: {field.low:g} to {field.high:g} nm"
                return self._show_message(reason, bad=True)
        values = {name: field.value() for name, field in self.fields.items()}
        mode = values.pop("mode")
        terms = {**self._state.terms, **values, self._mode_name: mode}
        self._set(terms={name: nm for name, nm in terms.items() if nm})

    def _clear_terms(self) -> None:
        for field in self.fields.values():
            field.setValue(0)
        self._set(terms={})

    def _set(
        self, terms: dict[str, float] | None = None, references: str = "keep", flat: str = "keep"
    ) -> None:
        self._ask(
            "set the offsets", lambda server: server.set_offsets(terms, references=references, flat=flat),
            "Applied.", terms=terms is not None,
        )  # fmt: skip

    def _load(self) -> None:
        name = self.saved.currentText()
        self._ask(
            "restore the offsets", lambda server: server.load_offsets(name), f"Restored '{name}'.",
            terms=True,
        )  # fmt: skip

    def _save(self) -> None:
        name = self.name.text().strip()
        self._ask("save the offsets", lambda server: server.save_offsets(name), f"Saved as '{name}'.")

    def _ask(
        self, what: str, call: Callable[[Connection], OffsetsState], done: str, *, terms: bool = False
    ) -> None:
        """Send a request; ``terms``: it sets the terms, so that the fields follow its answer."""
        sent = self._edited.copy() if terms else set()
        self._edited.difference_update(sent)
        self._show_message("Waiting for the server…")

        def on_done(state: OffsetsState) -> None:
            self._show(state)
            self._show_message(done)
            self._follow()

        def on_error(reason: str) -> None:
            self._edited.update(sent)
            self._show_message(reason, bad=True)

        self._session.ask(what, call, on_done, on_error, quiet=True)

    # ------------------------------------------------------------ display
    @property
    def _state(self) -> OffsetsState:
        return self._shown or OffsetsState()

    @property
    def _mode_name(self) -> str:
        return f"mode {self.mode_number.value():.0f}"

    def _terms_now(self) -> dict[str, float]:
        terms = self._state.terms
        return {name: terms.get(self._mode_name if name == "mode" else name, 0.0) for name in self.fields}

    def _show_mode(self) -> None:
        self._show(self._state)
        self._edited.discard("mode")
        self._follow()

    def _follow(self) -> None:
        """Show the present offsets in the fields that were not edited."""
        for name, value in self._terms_now().items():
            if name not in self._edited:
                self.fields[name].setValue(value)

    def update_buttons(self) -> None:
        """Show the newest offsets and what is possible now; called by the window while visible."""
        now = self._session.request_context
        if now.state.offsets != self._shown:
            self._show(now.state.offsets)
        why = reason_no_start(now)
        if not why and now.state.active_run is not None:
            why = "a procedure is running"
        missing = {
            "load": "" if self.saved.count() else "nothing is saved",
            "save": "" if self.name.text().strip() else "give a name",
        }
        for name, button in self.buttons.items():
            set_available(button, _BUTTONS[name][1], why or missing.get(name, ""))

    def _show(self, state: OffsetsState) -> None:
        self._shown = state
        for name, value in self._terms_now().items():
            self.current[name].setText(f"{value:.1f}")
        self.references.setText(f"Reference slopes: {'measured' if state.references else 'of the matrix'}")
        self.flat.setText(f"Flat: {'set' if state.flat else 'zero'}")
        if [self.saved.itemText(k) for k in range(self.saved.count())] != list(state.saved):
            self.saved.clear()
            self.saved.addItems(state.saved)

    def _show_message(self, text: str, *, bad: bool = False) -> None:
        self.message.setText(text)
        self.message.setStyleSheet(f"color: {self._theme.colour('bad' if bad else 'text').name()};")

    def _apply_theme(self) -> None:
        for widget in (*self.current.values(), *self.fields.values(), self.mode_number):
            widget.setFont(self._theme.font(mono=True))
        self.message.setMinimumHeight(self._theme.pixels(36))
        self.setMinimumWidth(self._theme.pixels(460))
