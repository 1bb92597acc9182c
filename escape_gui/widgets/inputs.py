"""Input fields that only the operator's own keys, clicks and wheel change."""

from __future__ import annotations

from PySide6.QtCore import QEvent, QLocale, QObject, Qt, Signal
from PySide6.QtGui import QHelpEvent, QPaintEvent, QValidator
from PySide6.QtWidgets import (
    QAbstractSpinBox,
    QComboBox,
    QDoubleSpinBox,
    QStyle,
    QStyleOptionComboBox,
    QStylePainter,
    QToolTip,
    QWidget,
)

#: Range in which a number can be typed, so that a value out of its limits can be reported.
_TYPED_RANGE = 1e6
#: Letters of a field that are visible in a narrow window, and room beside the text of a choice, pixels.
LEAST_LETTERS, _TEXT_MARGIN_PX = 6, 8


class _WheelFilter(QObject):
    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        if event.type() is QEvent.Type.Wheel and isinstance(watched, QWidget) and not watched.hasFocus():
            event.ignore()
            return True
        return False


def ignore_wheel_without_focus(widget: QWidget) -> None:
    """Pass the wheel on to the scroll area around a field that does not have the focus."""
    widget.setFocusPolicy(Qt.FocusPolicy.StrongFocus)
    widget.installEventFilter(_WheelFilter(widget))


class NumberBox(QDoubleSpinBox):
    """A number with limits. Other numbers can be typed, to be reported; arrows and wheel stay within them.

    Numbers have a decimal point in every language of the system, as everywhere in the window, and no group
    separators; a typed comma becomes a point.
    """

    #: The operator changed the value: emitted from the first key on, but not by :meth:`setValue`.
    edited = Signal()

    def __init__(self, low: float, high: float, *, step: float, decimals: int) -> None:
        super().__init__()
        self.low, self.high = low, high
        self.setRange(-_TYPED_RANGE, _TYPED_RANGE)
        self.setSingleStep(step)
        self.setDecimals(decimals)
        locale = QLocale.c()
        locale.setNumberOptions(
            QLocale.NumberOption.OmitGroupSeparator | QLocale.NumberOption.RejectGroupSeparator
        )
        self.setLocale(locale)
        self._typed = False
        self.lineEdit().textEdited.connect(self._on_typed)
        # Emitted after the previous signal, when Qt has updated the value.
        self.lineEdit().textChanged.connect(self._on_text)
        ignore_wheel_without_focus(self)

    def _on_typed(self) -> None:
        self._typed = True

    def _on_text(self) -> None:
        if self._typed:
            self._typed = False
            self.edited.emit()

    def validate(self, text: str, pos: int) -> tuple[QValidator.State, str, int]:
        return super().validate(text.replace(",", "."), pos)

    def stepBy(self, steps: int) -> None:
        self.interpretText()
        self.setValue(min(max(self.value() + steps * self.singleStep(), self.low), self.high))
        self.edited.emit()

    def stepEnabled(self) -> QAbstractSpinBox.StepEnabledFlag:
        flags = QAbstractSpinBox.StepEnabledFlag.StepNone
        if self.value() > self.low:
            flags |= QAbstractSpinBox.StepEnabledFlag.StepDownEnabled
        if self.value() < self.high:
            flags |= QAbstractSpinBox.StepEnabledFlag.StepUpEnabled
        return flags


class NameSelector(QComboBox):
    """A choice of long names, such as those of matrices, that does not widen its panel.

    A name that does not fit is elided in its middle, since names often differ at the end; the list and the
    tooltip have the whole names.
    """

    def __init__(self) -> None:
        super().__init__()
        self.setMinimumContentsLength(LEAST_LETTERS)
        self.setSizeAdjustPolicy(QComboBox.SizeAdjustPolicy.AdjustToMinimumContentsLengthWithIcon)
        ignore_wheel_without_focus(self)

    @property
    def shown_text(self) -> str:
        """The displayed text: the name, elided in the middle if it does not fit."""
        option = QStyleOptionComboBox()
        self.initStyleOption(option)
        place = self.style().subControlRect(
            QStyle.ComplexControl.CC_ComboBox, option, QStyle.SubControl.SC_ComboBoxEditField, self
        )
        middle = Qt.TextElideMode.ElideMiddle
        return self.fontMetrics().elidedText(self.currentText(), middle, place.width() - _TEXT_MARGIN_PX)

    def paintEvent(self, event: QPaintEvent) -> None:
        painter, option = QStylePainter(self), QStyleOptionComboBox()
        self.initStyleOption(option)
        option.currentText = self.shown_text
        painter.drawComplexControl(QStyle.ComplexControl.CC_ComboBox, option)
        painter.drawControl(QStyle.ControlElement.CE_ComboBoxLabel, option)

    def showPopup(self) -> None:
        self.view().setMinimumWidth(self.view().sizeHintForColumn(0) + 2 * _TEXT_MARGIN_PX)
        super().showPopup()

    def event(self, event: QEvent) -> bool:
        if isinstance(event, QHelpEvent) and self.shown_text != self.currentText():
            QToolTip.showText(event.globalPos(), f"{self.currentText()}\n{self.toolTip()}".strip(), self)
            return True
        return super().event(event)
