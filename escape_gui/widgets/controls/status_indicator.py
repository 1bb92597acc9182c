"""A condition as shape, text and colour, readable with any colour vision."""

from __future__ import annotations

from enum import Enum

from PySide6.QtCore import QPointF, QRectF, QSize, Qt
from PySide6.QtGui import QColor, QPainter, QPaintEvent, QPolygonF
from PySide6.QtWidgets import QSizePolicy, QWidget

from escape_gui.theme import Theme
from escape_hw.remote.state import DeviceHealth


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
        theme.changed.connect(self._apply_theme)
        self._apply_theme()

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
