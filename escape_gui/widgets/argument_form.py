"""Form generated from the server's declaration of a procedure."""

from __future__ import annotations

import itertools
from collections.abc import Sequence

from PySide6.QtCore import QSignalBlocker, QSize, Qt, Signal
from PySide6.QtWidgets import (
    QCheckBox,
    QComboBox,
    QFormLayout,
    QLabel,
    QLineEdit,
    QSizePolicy,
    QWidget,
)

from escape_gui.views import procedure_form as form_text
from escape_gui.views.convergence import short_unit
from escape_gui.widgets.controls import caption, column, row, scroll_area
from escape_gui.widgets.inputs import LEAST_LETTERS, NameSelector
from escape_hw.remote.state import Arguments, ProcedureParameter


class ArgumentForm(QWidget):
    """One row for each argument; optional arguments may be empty."""

    #: A value was changed.
    edited = Signal()

    def __init__(self, previous: QWidget) -> None:
        """``previous``: the widget from which the Tab key leads to the first field."""
        super().__init__()
        self._previous = previous
        self._parameters: tuple[ProcedureParameter, ...] = ()
        self.fields: dict[str, QWidget] = {}
        self._matrices: tuple[str, ...] = ()
        #: Texts of the fields that the operator changed, by the name of the argument.
        self._entered: dict[str, str] = {}
        self._area = scroll_area()
        # The Tab key goes to the fields.
        self._area.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self._area.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        column(self._area, parent=self)
        # The next widget is directly below the last argument; on a small screen the form scrolls.
        self.setSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Maximum)

    def sizeHint(self) -> QSize:
        hint, page = super().sizeHint(), self._area.widget()
        return hint if page is None else QSize(hint.width(), page.sizeHint().height())

    def show_parameters(
        self, parameters: Sequence[ProcedureParameter], matrices: tuple[str, ...], entered: dict[str, str]
    ) -> None:
        """Build the form, with the entered texts where they are valid, else with the default values.

        Parameters
        ----------
        parameters
            Declarations of the arguments.
        matrices
            Names of the matrices to choose from.
        entered
            Texts entered before, by the name of the argument; texts that are entered later are added. A text
            that is not valid here stays in it, for a server on which it is.
        """
        self._parameters, self._matrices, self._entered = tuple(parameters), matrices, entered
        self.fields = {}
        page = QWidget()
        form = QFormLayout(page)
        form.setContentsMargins(0, 0, 8, 0)
        form.setVerticalSpacing(4)
        form.setHorizontalSpacing(8)
        form.setFieldGrowthPolicy(QFormLayout.FieldGrowthPolicy.AllNonFixedFieldsGrow)
        for one in self._parameters:
            field = self._make_field(one)
            field.setToolTip(form_text.parameter_hint(one))
            field.setAccessibleName(form_text.label(one))
            field.setAccessibleDescription(form_text.parameter_hint(one))
            self.fields[one.name] = field
            name = QLabel(form_text.label(one))
            name.setToolTip(form_text.parameter_hint(one))
            name.setBuddy(field)
            form.addRow(name, row((field, 1), *([caption(short_unit(one.unit))] if one.unit else [])))
        self._area.setWidget(page)
        # New widgets are the last ones in the window for the Tab key.
        for before, after in itertools.pairwise((self._previous, *self.fields.values())):
            QWidget.setTabOrder(before, after)
        self.updateGeometry()
        for one in self._parameters:
            self._restore(one)

    def _restore(self, one: ProcedureParameter) -> None:
        """Show what was entered for an argument, if it is valid."""
        text, field = self._entered.get(one.name), self.fields[one.name]
        if text is None:
            return
        blocker = QSignalBlocker(field)
        if isinstance(field, QCheckBox):
            field.setChecked(text == str(True))
        elif isinstance(field, QComboBox):
            # A text that is none of the choices changes nothing.
            field.setCurrentText(text)
        elif isinstance(field, QLineEdit) and form_text.is_valid(one, text):
            field.setText(text)
        blocker.unblock()

    @property
    def rejected(self) -> dict[str, str]:
        """Entered texts that are not shown, since they are not valid here, by the label of the argument."""
        return {
            form_text.label(one): self._entered[one.name]
            for one in self._parameters
            if one.name in self._entered and self._entered[one.name] != _text(self.fields[one.name])
        }

    def set_matrix_choices(self, matrices: tuple[str, ...]) -> None:
        """Replace the matrices to choose from; a choice is kept, otherwise the newest is the default."""
        if matrices == self._matrices:
            return
        self._matrices = matrices
        for one in self._parameters:
            field = self.fields[one.name]
            if one.kind == "matrix" and isinstance(field, QComboBox):
                field.blockSignals(True)
                field.clear()
                field.addItems([form_text.NO_CHOICE, *matrices])
                field.setCurrentText(self._default_matrix(one))
                field.blockSignals(False)
                self._restore(one)
        self.edited.emit()

    def _default_matrix(self, parameter: ProcedureParameter) -> str:
        return self._matrices[0] if parameter.name == "im" and self._matrices else form_text.NO_CHOICE

    def _make_field(self, one: ProcedureParameter) -> QWidget:
        def edited(*_: object) -> None:
            self._entered[one.name] = _text(self.fields[one.name])
            self.edited.emit()

        if one.kind == "bool":
            check = QCheckBox()
            check.setChecked(bool(one.default))
            check.toggled.connect(edited)
            return check
        if one.kind in ("choice", "matrix"):
            box = NameSelector()
            box.addItems(
                list(one.choices) if one.kind == "choice" else [form_text.NO_CHOICE, *self._matrices]
            )
            box.setCurrentText(
                form_text.format_value(one.default) if one.kind == "choice" else self._default_matrix(one)
            )
            box.currentIndexChanged.connect(edited)
            return box
        line = QLineEdit(form_text.format_value(one.default))
        if one.default is None:
            line.setPlaceholderText("none")
        line.setMinimumWidth(line.fontMetrics().horizontalAdvance("0" * LEAST_LETTERS))
        line.textEdited.connect(edited)
        return line

    def arguments(self) -> Arguments:
        """Values that differ from their defaults (ValueError: invalid field; gives the allowed values)."""
        values: Arguments = {}
        for one in self._parameters:
            field = self.fields[one.name]
            if isinstance(field, QCheckBox):
                values[one.name] = field.isChecked()
            else:
                values[one.name] = form_text.parse_value(one, _text(field))
        return form_text.non_default_arguments(self._parameters, values)


def _text(field: QWidget) -> str:
    """Content of a field; ``True`` or ``False`` for a check box."""
    if isinstance(field, QCheckBox):
        return str(field.isChecked())
    if isinstance(field, QComboBox):
        return field.currentText()
    return field.text() if isinstance(field, QLineEdit) else ""
