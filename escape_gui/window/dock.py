"""A dock: a panel under a slim title with its condition, a menu to save it, and its help."""

from __future__ import annotations

from PySide6.QtCore import QSize, Qt, Signal
from PySide6.QtWidgets import (
    QDockWidget,
    QFrame,
    QHBoxLayout,
    QLabel,
    QMainWindow,
    QMenu,
    QScrollArea,
    QToolButton,
    QWidget,
)

from escape_gui.panels.base import Panel
from escape_gui.theme import Theme
from escape_gui.widgets.controls.status_indicator import Level, StatusIndicator
from escape_hw.remote.state import DeviceHealth

HEALTH_LEVELS: dict[DeviceHealth, Level] = {
    DeviceHealth.OK: Level.GOOD,
    DeviceHealth.STALE: Level.WARNING,
    DeviceHealth.LOST: Level.ERROR,
    DeviceHealth.FAULT: Level.ERROR,
    DeviceHealth.CLOSED: Level.NEUTRAL,
}


#: Height below which a panel is scrolled instead of making the window higher, pixels.
MIN_PANEL_HEIGHT_PX = 130


class _PanelScrollArea(QScrollArea):
    """A panel's room: it may be lower than the panel wants, never narrower."""

    def __init__(self, panel: Panel) -> None:
        super().__init__()
        self._panel = panel
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setHorizontalScrollBarPolicy(Qt.ScrollBarPolicy.ScrollBarAlwaysOff)
        self.setWidget(panel)

    def minimumSizeHint(self) -> QSize:
        """The panel's width with a scroll bar, and little height."""
        least = self._panel.minimumSizeHint()
        bar = self.verticalScrollBar().sizeHint().width() if least.height() > MIN_PANEL_HEIGHT_PX else 0
        return QSize(least.width() + bar, min(least.height(), MIN_PANEL_HEIGHT_PX))

    def sizeHint(self) -> QSize:
        """What the panel wants."""
        return self._panel.sizeHint()


class Dock(QDockWidget):
    """A panel in its frame.

    Parameters
    ----------
    panel
        The content.
    theme
        Colours and fonts.
    window
        Where it docks.
    """

    #: Panel's name and ``png``, ``csv`` or ``fits``.
    save_requested = Signal(str, str)
    #: Panel's name.
    help_requested = Signal(str)

    def __init__(self, panel: Panel, theme: Theme, window: QMainWindow) -> None:
        # Without the window Qt would not find it when it restores a layout.
        super().__init__(panel.title, window)
        self.setObjectName(panel.name)
        self.panel = panel
        self._theme = theme
        self.setWidget(_PanelScrollArea(panel))
        self._title = QLabel(panel.title)
        self._pill = StatusIndicator(theme)
        self.setTitleBarWidget(self._make_title())
        theme.changed.connect(self._apply_theme)
        self._apply_theme()

    def _make_title(self) -> QWidget:
        bar = QWidget()
        bar.setObjectName("title")
        bar.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        row = QHBoxLayout(bar)
        row.setContentsMargins(8, 2, 4, 2)
        row.setSpacing(4)
        row.addWidget(self._title)
        row.addStretch()
        row.addWidget(self._pill)
        name = self.panel.name
        save = _flat_button("⤓", f"Save {self.panel.title}: picture, table or FITS")
        save.setPopupMode(QToolButton.ToolButtonPopupMode.InstantPopup)
        menu = QMenu(save)
        for kind, text in (("png", "Picture (PNG)"), ("csv", "Table (CSV)"), ("fits", "Arrays (FITS)")):
            menu.addAction(text).triggered.connect(
                lambda _=False, kind=kind: self.save_requested.emit(name, kind)
            )
        save.setMenu(menu)
        help_button = _flat_button("?", f"Help on {self.panel.title}")
        help_button.clicked.connect(lambda: self.help_requested.emit(name))
        close_button = _flat_button("×", f"Hide {self.panel.title}; View brings it back")
        close_button.clicked.connect(self.close)
        for button in (save, help_button, close_button):
            row.addWidget(button)
        return bar

    def show_health(self) -> None:
        """Bring the condition in the title up to date; a panel that is well says nothing."""
        health = self.panel.health
        quiet = health is DeviceHealth.OK or (self.panel.shows_placeholder and health is DeviceHealth.STALE)
        self._pill.setVisible(not quiet)
        if not quiet:
            self._pill.set_status(HEALTH_LEVELS[health], health.value)

    def _apply_theme(self) -> None:
        self._title.setFont(self._theme.font(bold=True))


def _flat_button(text: str, tip: str) -> QToolButton:
    button = QToolButton()
    button.setObjectName("quiet")
    button.setText(text)
    button.setToolTip(tip)
    button.setAccessibleName(tip)
    button.setStyleSheet("QToolButton::menu-indicator { image: none; }")
    return button
