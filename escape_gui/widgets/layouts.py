"""Rows, columns, captions and flat buttons that panels and widgets are built from."""

from __future__ import annotations

from typing import TypeAlias, TypeVar

from PySide6.QtCore import Qt
from PySide6.QtWidgets import (
    QBoxLayout,
    QHBoxLayout,
    QLabel,
    QLayout,
    QScrollArea,
    QToolButton,
    QVBoxLayout,
    QWidget,
)

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


def text_label() -> QLabel:
    """A label with wrapped, selectable text."""
    label = QLabel()
    label.setWordWrap(True)
    label.setTextInteractionFlags(Qt.TextInteractionFlag.TextSelectableByMouse)
    return label


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


def scroll_area(content: QWidget | None = None) -> QScrollArea:
    """A scroll area without a frame whose content takes its width."""
    area = QScrollArea()
    area.setWidgetResizable(True)
    area.setFrameShape(QScrollArea.Shape.NoFrame)
    if content is not None:
        area.setWidget(content)
    return area
