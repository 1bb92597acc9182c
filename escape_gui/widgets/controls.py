"""Layouts, labels, buttons, readouts, indicators, and a page of text over the window."""

from __future__ import annotations

from collections.abc import Sequence
from enum import Enum
from typing import TypeAlias, TypeVar

from PySide6.QtCore import QElapsedTimer, QEvent, QObject, QPointF, QRectF, QSize, Qt, QTimer, Signal
from PySide6.QtGui import QColor, QKeyEvent, QPainter, QPaintEvent, QPolygonF, QResizeEvent
from PySide6.QtWidgets import (
    QBoxLayout,
    QButtonGroup,
    QFrame,
    QGridLayout,
    QHBoxLayout,
    QLabel,
    QLayout,
    QPlainTextEdit,
    QPushButton,
    QScrollArea,
    QSizePolicy,
    QTextBrowser,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

from escape_gui.client.availability import tooltip
from escape_gui.theme import Theme
from escape_hw.remote.state import DeviceHealth
from escape_hw.report.verdict import Quality

#: A widget or layout, one with its stretch factor, or ``None`` for stretchable space.
Item: TypeAlias = QWidget | QLayout | tuple[QWidget | QLayout, int] | None
_Box = TypeVar("_Box", bound=QBoxLayout)


def row(*items: Item, parent: QWidget | None = None, spacing: int = 8) -> QHBoxLayout:
    """Items from left to right without margins; the layout of ``parent`` if given."""
    return _fill(QHBoxLayout() if parent is None else QHBoxLayout(parent), items, spacing)


def column(*items: Item, parent: QWidget | None = None, spacing: int = 8) -> QVBoxLayout:
    """Items from top to bottom without margins; the layout of ``parent`` if given."""
    return _fill(QVBoxLayout() if parent is None else QVBoxLayout(parent), items, spacing)


def _fill(box: _Box, items: tuple[Item, ...], spacing: int) -> _Box:
    box.setContentsMargins(0, 0, 0, 0)
    box.setSpacing(spacing)
    for one in items:
        if one is None:
            box.addStretch()
            continue
        item, stretch = one if isinstance(one, tuple) else (one, 0)
        if isinstance(item, QWidget):
            box.addWidget(item, stretch)
        else:
            box.addLayout(item, stretch)
    return box


def caption(text: str = "") -> QLabel:
    """A label in the muted colour."""
    label = QLabel(text)
    label.setObjectName("caption")
    return label


class ElidedLabel(QLabel):
    """A label in one line that does not widen its panel; the tooltip has the whole text."""

    def __init__(self, text: str = "") -> None:
        super().__init__()
        self.setTextFormat(Qt.TextFormat.PlainText)
        self.setSizePolicy(QSizePolicy.Policy.Ignored, QSizePolicy.Policy.Fixed)
        self.whole_text = ""
        self.show_text(text)

    def show_text(self, text: str) -> None:
        self.whole_text = text
        self.setToolTip(text)
        self.setAccessibleName(text)
        self._elide()

    def _elide(self) -> None:
        self.setText(
            self.fontMetrics().elidedText(self.whole_text, Qt.TextElideMode.ElideMiddle, self.width())
        )

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._elide()


def text_label() -> QLabel:
    """A label with wrapped, selectable text."""
    label = QLabel()
    label.setWordWrap(True)
    label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    return label


def fit_height(label: QLabel) -> None:
    """Set the minimum height of wrapped text; the layout of a panel ignores its height for width."""
    # The height for a width is never less than the minimum.
    label.setMinimumHeight(0)
    if label.text():
        label.setMinimumHeight(max(0, label.heightForWidth(label.width())))


def flat_button(text: str, tip: str, *, checkable: bool = False, checked: bool = False) -> QToolButton:
    """A button without a frame; the tooltip is its accessible name, too."""
    button = QToolButton()
    button.setObjectName("quiet")
    button.setText(text)
    button.setToolTip(tip)
    button.setAccessibleName(tip)
    button.setCheckable(checkable)
    button.setChecked(checked)
    return button


def set_available(button: QPushButton, tip: str, reason: str) -> None:
    """Enable a button, or disable it and give the reason in its tooltip."""
    button.setEnabled(not reason)
    button.setToolTip(tooltip(tip, reason))


def scroll_area(content: QWidget | None = None) -> QScrollArea:
    """A scroll area without a frame whose content takes its width."""
    area = QScrollArea()
    area.setWidgetResizable(True)
    area.setFrameShape(QScrollArea.Shape.NoFrame)
    if content is not None:
        area.setWidget(content)
    return area


class TextArea(QScrollArea):
    """Text as high as its lines, up to ``most_lines``; what is more scrolls."""

    def __init__(self, most_lines: int) -> None:
        super().__init__()
        self._most_lines = most_lines
        self.label = text_label()
        self.setWidgetResizable(True)
        self.setFrameShape(QScrollArea.Shape.NoFrame)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setWidget(self.label)
        policy = QSizePolicy(QSizePolicy.Policy.Preferred, QSizePolicy.Policy.Fixed)
        policy.setHeightForWidth(True)
        self.setSizePolicy(policy)

    def set_text(self, text: str) -> None:
        """Show a text, or hide the area if there is none."""
        self.label.setText(text)
        self.setVisible(bool(text))
        self.updateGeometry()

    def hasHeightForWidth(self) -> bool:
        return True

    def heightForWidth(self, width: int) -> int:
        return min(self.label.heightForWidth(width), self._most_lines * self.fontMetrics().lineSpacing())

    def sizeHint(self) -> QSize:
        return QSize(super().sizeHint().width(), self.heightForWidth(max(self.width(), 1)))

    def minimumSizeHint(self) -> QSize:
        return QSize(0, self.fontMetrics().lineSpacing())


HOLD_MS = 800
_STEP_MS = 40


class SegmentedButton(QWidget):
    """A row of buttons of which exactly one is pressed, at the start the first."""

    chosen = Signal(str)

    def __init__(self, name: str, choices: Sequence[str], tips: Sequence[str]) -> None:
        super().__init__()
        self.setAccessibleName(name)
        group = QButtonGroup(self)
        self.buttons: dict[str, QToolButton] = {}
        for text, tip in zip(choices, tips, strict=True):
            button = flat_button(text, tip, checkable=True, checked=not self.buttons)
            button.setAccessibleName(f"{name}: {text}")
            button.clicked.connect(lambda _=False, text=text: self.chosen.emit(text))
            group.addButton(button)
            self.buttons[text] = button
        row(*self.buttons.values(), parent=self, spacing=2)
        self.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)

    @property
    def selected(self) -> str:
        return next(text for text, button in self.buttons.items() if button.isChecked())

    def choose(self, text: str) -> None:
        self.buttons[text].click()


class LogText(QPlainTextEdit):
    """Lines of a log. It follows the newest one until the operator scrolls up."""

    def __init__(self, name: str, max_lines: int) -> None:
        super().__init__()
        self.setReadOnly(True)
        self.setMaximumBlockCount(max_lines)
        self.setAccessibleName(name)
        self._follows_newest = True
        self.verticalScrollBar().actionTriggered.connect(self._on_scroll)

    def _on_scroll(self) -> None:
        bar = self.verticalScrollBar()
        self._follows_newest = bar.sliderPosition() >= bar.maximum()

    def show_newest(self) -> None:
        """Scroll to the end; called often, because lines wrap anew when the panel is resized."""
        if self._follows_newest:
            bar = self.verticalScrollBar()
            bar.setValue(bar.maximum())


class HoldButton(QPushButton):
    """A button for hazardous actions: emits :attr:`confirmed` after it was held for :data:`HOLD_MS`.

    It can be held with the mouse, Space or Return; a growing bar shows the time.
    """

    confirmed = Signal()

    def __init__(self, text: str, theme: Theme) -> None:
        super().__init__(f"Hold to {text}")
        self._theme = theme
        self._clock = QElapsedTimer()
        self._timer = QTimer(self)
        self._timer.setInterval(_STEP_MS)
        self._timer.timeout.connect(self._step)
        self.pressed.connect(self._begin)
        self.released.connect(self._end)

    def _begin(self) -> None:
        self._clock.start()
        self._timer.start()

    def _end(self) -> None:
        self._timer.stop()
        self.update()

    def _step(self) -> None:
        if self._clock.elapsed() >= HOLD_MS:
            self._timer.stop()
            self.setDown(False)
            self.confirmed.emit()
        self.update()

    def keyPressEvent(self, event: QKeyEvent) -> None:
        """Treat Return like Space; a key that repeats automatically is one press."""
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            if not event.isAutoRepeat() and not self.isDown():
                self.setDown(True)
                self.pressed.emit()
            return
        super().keyPressEvent(event)

    def keyReleaseEvent(self, event: QKeyEvent) -> None:
        if event.key() in (Qt.Key.Key_Return, Qt.Key.Key_Enter):
            if not event.isAutoRepeat() and self.isDown():
                self.setDown(False)
                self.released.emit()
            return
        super().keyReleaseEvent(event)

    def paintEvent(self, event: QPaintEvent) -> None:
        super().paintEvent(event)
        if self._timer.isActive():
            share = min(self._clock.elapsed() / HOLD_MS, 1.0)
            bar = QRectF(0, self.height() - 4, self.width() * share, 4)
            QPainter(self).fillRect(bar, self._theme.colour("warn"))


class Readout(QWidget):
    """Caption, value and unit in a row; the value is right-aligned in a field of ``digits`` characters."""

    def __init__(self, theme: Theme, name: str, unit: str, digits: int) -> None:
        super().__init__()
        self._theme, self._name, self._unit, self._digits = theme, name, unit, digits
        self._value = QLabel("–")
        self._value.setAlignment(Qt.AlignmentFlag.AlignRight | Qt.AlignmentFlag.AlignVCenter)
        self._caption = caption(name)
        row(self._caption, self._value, caption(unit), parent=self, spacing=4)
        self.setSizePolicy(QSizePolicy.Policy.Maximum, QSizePolicy.Policy.Fixed)
        theme.follow(self._apply_theme)

    @property
    def text(self) -> str:
        return self._value.text()

    def set_name(self, name: str) -> None:
        """Change the caption."""
        if name != self._name:
            self._name = name
            self._caption.setText(name)

    def show_value(self, text: str) -> None:
        if text != self._value.text():
            self._value.setText(text)
            self.setAccessibleName(f"{self._name} {text} {self._unit}")

    def _apply_theme(self) -> None:
        self._value.setFont(self._theme.font(mono=True))
        self._value.setMinimumWidth(self._value.fontMetrics().horizontalAdvance("0" * self._digits))


def readout_grid(readouts: dict[str, Readout]) -> QGridLayout:
    """Readouts in two columns, left-aligned."""
    grid = QGridLayout()
    grid.setHorizontalSpacing(24)
    grid.setVerticalSpacing(2)
    for k, readout in enumerate(readouts.values()):
        grid.addWidget(readout, k // 2, k % 2)
    grid.setColumnStretch(2, 1)
    return grid


class Level(Enum):
    """Severity of a condition; the value is its colour in the palette."""

    NEUTRAL = "muted"
    GOOD = "good"
    ACTIVE = "accent"
    WARNING = "warn"
    ERROR = "bad"


HEALTH_LEVELS: dict[DeviceHealth, Level] = {
    DeviceHealth.OK: Level.GOOD,
    DeviceHealth.STALE: Level.WARNING,
    DeviceHealth.LOST: Level.ERROR,
    DeviceHealth.FAULT: Level.ERROR,
    DeviceHealth.CLOSED: Level.NEUTRAL,
}


QUALITY_LEVELS: dict[Quality, Level] = {
    Quality.GOOD: Level.GOOD, Quality.USABLE: Level.WARNING, Quality.NOT_USABLE: Level.ERROR,
    Quality.ABORTED: Level.WARNING,
}  # fmt: skip


class StatusIndicator(QWidget):
    """Text beside a shape: disc good, ring neutral, play mark active, triangle warning, square error.

    ``widest_text`` sets the minimum width, so that neighbours do not move when the text changes.
    """

    def __init__(self, theme: Theme, widest_text: str = "") -> None:
        super().__init__()
        self._theme = theme
        self._widest_text = widest_text
        self.level = Level.NEUTRAL
        self.text = ""
        self.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        theme.follow(self._apply_theme)

    def set_status(self, level: Level, text: str) -> None:
        if (level, text) == (self.level, self.text):
            return
        longer = len(text) > len(self._widest_text) and len(text) != len(self.text)
        self.level, self.text = level, text
        self.setAccessibleName(text)
        if longer:
            self.updateGeometry()
        self.update()

    def _apply_theme(self) -> None:
        self.setFont(self._theme.font(0.95, bold=True))
        self.updateGeometry()
        self.update()

    def sizeHint(self) -> QSize:
        metrics = self.fontMetrics()
        width = max(metrics.horizontalAdvance(text) for text in (self._widest_text, self.text))
        return QSize(width + round(1.9 * metrics.height()), round(1.5 * metrics.height()))

    def paintEvent(self, event: QPaintEvent) -> None:
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        colour = self._theme.colour(self.level.value)
        side = 0.62 * self.fontMetrics().height()
        _draw_shape(painter, QRectF(0.5 * side, (self.height() - side) / 2, side, side), self.level, colour)
        painter.setPen(colour)
        text = QRectF(self.rect()).adjusted(2.1 * side, 0, 0, 0)
        painter.drawText(text, Qt.AlignmentFlag.AlignVCenter | Qt.AlignmentFlag.AlignLeft, self.text)


def _draw_shape(painter: QPainter, box: QRectF, level: Level, colour: QColor) -> None:
    painter.setPen(colour)
    painter.setBrush(Qt.BrushStyle.NoBrush if level is Level.NEUTRAL else colour)
    if level in (Level.NEUTRAL, Level.GOOD):
        painter.drawEllipse(box)
    elif level is Level.ERROR:
        painter.drawRect(box)
    elif level is Level.WARNING:
        top = QPointF(box.center().x(), box.top())
        painter.drawPolygon(QPolygonF([top, box.bottomRight(), box.bottomLeft()]))
    else:
        right = QPointF(box.right(), box.center().y())
        painter.drawPolygon(QPolygonF([box.topLeft(), right, box.bottomLeft()]))


class Overlay(QFrame):
    """Page of text over a window, closed by Escape; the panels below keep updating."""

    def __init__(self, window: QWidget, theme: Theme) -> None:
        super().__init__(window)
        self._window, self._theme = window, theme
        self.setObjectName("overlay")
        self._title = QLabel()
        self._text = QTextBrowser()
        self._text.setOpenExternalLinks(True)
        close_button = QPushButton("Close (Esc)")
        close_button.clicked.connect(self.hide)
        head = row(self._title, None, close_button)
        column(head, self._text, parent=self).setContentsMargins(16, 12, 16, 16)
        window.installEventFilter(self)
        theme.follow(self._apply_theme)
        self.hide()

    def open(self, title: str, text: str, *, markdown: bool = False) -> None:
        self._title.setText(title)
        self.setAccessibleName(title)
        if markdown:
            self._text.setMarkdown(text)
        else:
            self._text.setHtml(text)
        self._place()
        self.show()
        self.raise_()
        self._text.setFocus()

    @property
    def page(self) -> str:
        """The text shown, without markup."""
        return self._text.toPlainText()

    def _place(self) -> None:
        width = min(self._theme.pixels(860), self._window.width() - 48)
        height = min(self._theme.pixels(640), self._window.height() - 96)
        self.setGeometry(
            (self._window.width() - width) // 2, (self._window.height() - height) // 2, width, height
        )

    def _apply_theme(self) -> None:
        colours = self._theme.colours
        self._title.setFont(self._theme.font(1.3, bold=True))
        self.setStyleSheet(
            f"#overlay {{ background: {colours.panel}; border: 1px solid {colours.accent};"
            " border-radius: 8px; }"
        )

    def keyPressEvent(self, event: QKeyEvent) -> None:
        if event.key() == Qt.Key.Key_Escape:
            self.hide()
        else:
            super().keyPressEvent(event)

    def eventFilter(self, watched: QObject, event: QEvent) -> bool:
        if event.type() is QEvent.Type.Resize and self.isVisible():
            self._place()
        return False
