"""Dock of a panel: a title bar with health indicator, export menu and help button."""

from __future__ import annotations

from PySide6.QtCore import QSize, Qt, Signal
from PySide6.QtWidgets import (
    QDockWidget,
    QFrame,
    QLabel,
    QMainWindow,
    QMenu,
    QScrollArea,
    QToolButton,
    QWidget,
)

from escape_gui.panels.base import Panel
from escape_gui.theme import Theme
from escape_gui.widgets.controls.status_indicator import HEALTH_LEVELS, StatusIndicator
from escape_gui.widgets.layouts import flat_button, row
from escape_hw.remote.state import DeviceHealth

#: Height below which a panel scrolls instead of enlarging the window, pixels.
MIN_PANEL_HEIGHT_PX = 130


class _PanelScrollArea(QScrollArea):
    """Lets a panel be lower than its minimum height, but not narrower than its minimum width."""

    def __init__(self, panel: Panel) -> None:
        super().__init__()
        self._panel = panel
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setWidget(panel)

    def minimumSizeHint(self) -> QSize:
        least = self._panel.minimumSizeHint()
        bar = self.verticalScrollBar().sizeHint().width() if least.height() > MIN_PANEL_HEIGHT_PX else 0
        return QSize(least.width() + bar, min(least.height(), MIN_PANEL_HEIGHT_PX))

    def sizeHint(self) -> QSize:
        return self._panel.sizeHint()


class Dock(QDockWidget):
    """Dock widget with a panel. It needs a parent: otherwise Qt does not restore its layout."""

    #: Name of the panel and ``png``, ``csv`` or ``fits``.
    save_requested = Signal(str, str)
    #: Name of the panel.
    help_requested = Signal(str)

    def __init__(self, panel: Panel, theme: Theme, window: QMainWindow) -> None:
        super().__init__(panel.title, window)
        self.setObjectName(panel.name)
        self.panel = panel
        self._theme = theme
        self.setWidget(_PanelScrollArea(panel))
        self._title = QLabel(panel.title)
        self._indicator = StatusIndicator(theme)
        self.setTitleBarWidget(self._make_title())
        theme.changed.connect(self._apply_theme)
        self._apply_theme()

    def _make_title(self) -> QWidget:
        name, title = self.panel.name, self.panel.title
        save = flat_button("⤓", f"Save {title}: image, table or FITS")
        save.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
        save.setStyleSheet("QToolButton::menu-indicator { image: none; }")
        menu = QMenu(save)
        for kind, text in (("png", "Image (PNG)"), ("csv", "Table (CSV)"), ("fits", "Arrays (FITS)")):
            menu.addAction(text).triggered.connect(
                lambda _=False, kind=kind: self.save_requested.emit(name, kind)
            )
        save.setMenu(menu)
        help_button = flat_button("?", f"Help on {title}")
        help_button.clicked.connect(lambda: self.help_requested.emit(name))
        close_button = flat_button("×", f"Hide {title} (restore through View)")
        close_button.clicked.connect(self.close)
        bar = QWidget()
        bar.setObjectName("title")
        bar.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        items = (self._title, None, self._indicator, save, help_button, close_button)
        row(*items, parent=bar, spacing=4).setContentsMargins(8, 2, 4, 2)
        return bar

    def show_health(self) -> None:
        """Show the health of the panel's data in the title, unless it is good."""
        health = self.panel.health
        hidden = health is DeviceHealth.OK or (self.panel.shows_placeholder and health is DeviceHealth.STALE)
        self._indicator.setVisible(not hidden)
        if not hidden:
            self._indicator.set_status(HEALTH_LEVELS[health], health.value)

    def _apply_theme(self) -> None:
        self._title.setFont(self._theme.font(bold=True))
