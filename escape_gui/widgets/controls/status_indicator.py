"""A condition as shape, word and colour, so that no colour needs to be told apart."""

from __future__ import annotations

from enum import Enum

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QPainter, QPaintEvent, QPolygonF
from PySide6.QtWidgets import QSizePolicy, QWidget

from escape_gui.theme import Theme


class Level(Enum):
    """How good a condition is, with the palette's colour for it."""

    NEUTRAL = "muted"
    GOOD = "good"
    ACTIVE = "accent"
    WARNING = "warn"
    ERROR = "bad"


class StatusIndicator(QWidget):
    """Shape, word and colour: disc good, ring quiet, play mark active, triangle warning, square bad.

    Parameters
    ----------
    theme
        Colours and font.
    widest
        The longest word it will show; keeps the width, so that nothing beside it moves.
    """

    def __init__(self, theme: Theme, widest_text: str = "") -> None:
        super().__init__()
        self._theme = theme
        self._widest = widest_text
        self.level = Level.NEUTRAL
        self.word = ""
        self.setSizePolicy(QSizePolicy.Policy.Fixed, QSizePolicy.Policy.Fixed)
        theme.changed.connect(self._apply_theme)
        self._apply_theme()

    def set_status(self, level: Level, word: str) -> None:
        """Show a condition."""
        if (level, word) == (self.level, self.word):
            return
        longer = len(word) > len(self._widest) and len(word) != len(self.word)
        self.level, self.word = level, word
        self.setAccessibleName(word)
        if longer:
            self.updateGeometry()
        self.update()

    def _apply_theme(self) -> None:
        self.setFont(self._theme.font(0.95, bold=True))
        self.updateGeometry()
        self.update()

    def sizeHint(self) -> QSize:
        """Room for the widest word."""
        metrics = self.fontMetrics()
        width = max(metrics.horizontalAdvance(word) for word in (self._widest, self.word))
        return QSize(width + round(1.9 * metrics.height()), round(1.5 * metrics.height()))

    def paintEvent(self, event: QPaintEvent) -> None:
        """Draw it."""
        painter = QPainter(self)
        painter.setRenderHint(QPainter.RenderHint.Antialiasing)
        colour = self._theme.colour(self.level.value)
        side = 0.62 * self.fontMetrics().height()
        box = QRectF(0.5 * side, (self.height() - side) / 2, side, side)
        draw_mark(painter, box, self.level, colour)
        painter.setPen(colour)
        text = QRectF(self.rect()).adjusted(2.1 * side, 0, 0, 0)
        painter.drawText(text, Qt.AlignmentFlag.AlignVCenter | Qt.AlignmentFlag.AlignLeft, self.word)


def draw_mark(painter: QPainter, box: QRectF, level: Level, colour: QColor) -> None:
    """Draw a level's shape into a square."""
    painter.setPen(colour)
    painter.setBrush(colour)
    if level is Level.NEUTRAL:
        painter.setBrush(Qt.BrushStyle.NoBrush)
        painter.drawEllipse(box)
    elif level is Level.GOOD:
        painter.drawEllipse(box)
    elif level is Level.ERROR:
        painter.drawRect(box)
    elif level is Level.WARNING:
        top = QPointF(box.center().x(), box.top())
        painter.drawPolygon(QPolygonF([top, box.bottomRight(), box.bottomLeft()]))
    else:
        right = QPointF(box.right(), box.center().y())
        painter.drawPolygon(QPolygonF([box.topLeft(), right, box.bottomLeft()]))
