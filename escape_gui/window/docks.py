"""Docks of the panels, and their arrangement in the workspaces for alignment, calibration and operation."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from itertools import pairwise

from PySide6.QtCore import QSize, Qt, Signal
from PySide6.QtWidgets import (
    QDockWidget,
    QFrame,
    QLabel,
    QMainWindow,
    QMenu,
    QScrollArea,
    QTabBar,
    QToolButton,
    QWidget,
)

from escape_gui.panels.base import Panel
from escape_gui.theme import Theme
from escape_gui.widgets.controls import HEALTH_LEVELS, StatusIndicator, flat_button, row
from escape_hw.remote.state import DeviceHealth

#: Height and width below which a panel scrolls instead of enlarging the window, pixels. Three columns of
#: this width fit a window of 1024 pixels.
MIN_PANEL_HEIGHT_PX, MIN_PANEL_WIDTH_PX = 130, 320


class _PanelScrollArea(QScrollArea):
    """Lets a panel be smaller than its minimum size."""

    def __init__(self, panel: Panel) -> None:
        super().__init__()
        self._panel = panel
        self.setWidgetResizable(True)
        self.setFrameShape(QFrame.Shape.NoFrame)
        self.setFocusPolicy(Qt.FocusPolicy.NoFocus)
        self.setWidget(panel)

    def minimumSizeHint(self) -> QSize:
        least = self._panel.minimumSizeHint()
        bar = self.verticalScrollBar().sizeHint().width() if least.height() > MIN_PANEL_HEIGHT_PX else 0
        width = min(least.width() + bar, MIN_PANEL_WIDTH_PX)
        return QSize(width, min(least.height(), MIN_PANEL_HEIGHT_PX))

    def sizeHint(self) -> QSize:
        return self._panel.sizeHint()


class Dock(QDockWidget):
    """Dock widget with a panel. It needs a parent: otherwise Qt does not restore its layout."""

    #: Name of the panel and ``png``, ``csv`` or ``fits``.
    save_requested = Signal(str, str)
    #: Name of the panel.
    help_requested = Signal(str)

    def __init__(self, panel: Panel, theme: Theme, window: QMainWindow) -> None:
        super().__init__(panel.tab_title or panel.title, window)
        self.toggleViewAction().setText(panel.title)
        self.setObjectName(panel.name)
        self.panel = panel
        self._theme = theme
        self.setWidget(_PanelScrollArea(panel))
        self._title = QLabel(panel.title)
        self._indicator = StatusIndicator(theme)
        self.setTitleBarWidget(self._make_title())
        theme.follow(self._apply_theme)

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


#: Width of the separator between docks in the style sheet.
SEPARATOR_PX = 6


@dataclass(frozen=True, slots=True)
class Cell:
    """Panels as tabs, the first in front; ``share`` is the height relative to the other cells of a column."""

    names: tuple[str, ...]
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class Column:
    """Cells from top to bottom; ``share`` is the width relative to the other columns."""

    cells: tuple[Cell, ...]
    share: float = 1.0


@dataclass(frozen=True, slots=True)
class Workspace:
    """A named arrangement of panels: columns of a window of any size, and of a large one."""

    name: str
    title: str
    purpose: str
    columns: tuple[Column, ...]
    large_columns: tuple[Column, ...]

    def arranged(self, large: bool) -> Workspace:
        """The workspace with the columns of a large window, or with the others."""
        return replace(self, columns=self.large_columns) if large else self

    @property
    def panels(self) -> tuple[str, ...]:
        return tuple(name for column in self.columns for cell in column.cells for name in cell.names)


WORKSPACES: tuple[Workspace, ...] = (
    Workspace(
        "align",
        "Align",
        "Devices, light on the sensor, shape of the mirror",
        (
            Column((Cell(("devices",), 1.5), Cell(("log",), 1.0)), 1.0),
            Column((Cell(("camera",)),), 1.5),
            Column((Cell(("mirror",), 1.0), Cell(("psf",), 1.2)), 1.0),
        ),
        (
            Column((Cell(("devices",), 0.6), Cell(("log",), 1.0)), 0.9),
            Column((Cell(("camera",)),), 1.5),
            Column((Cell(("mirror",), 1.0), Cell(("psf",), 1.2)), 1.0),
        ),
    ),
    Workspace(
        "calibrate",
        "Calibrate",
        "Interaction matrix, registration, optical gains",
        (
            # Form, plan and result fill a column of a small screen.
            Column((Cell(("procedure",)),), 0.95),
            # The mosaic and the detail of a mode share a column.
            Column((Cell(("modes",)),), 1.25),
            Column((Cell(("sprint",), 1.3), Cell(("gains", "camera", "devices", "log"), 1.0)), 1.2),
        ),
        (
            Column((Cell(("procedure",), 2.6), Cell(("log", "devices"), 0.8)), 0.9),
            Column((Cell(("modes",)),), 1.3),
            Column((Cell(("sprint",)),), 1.0),
            Column((Cell(("camera",), 1.2), Cell(("gains",), 1.0)), 0.9),
        ),
    ),
    Workspace(
        "operate",
        "Operate",
        "Closed loop, Strehl, latency",
        (
            # The button that closes the loop is visible on a small screen.
            Column((Cell(("loop",), 1.6), Cell(("devices", "procedure"), 1.0)), 0.9),
            Column(
                (Cell(("performance", "trends", "telemetry"), 1.4), Cell(("night", "log", "latency"), 0.9)),
                1.5,
            ),
            Column((Cell(("camera",), 1.0), Cell(("psf", "mirror"), 1.15)), 1.1),
        ),
        (
            Column((Cell(("loop",), 1.0), Cell(("devices", "procedure"), 0.9), Cell(("log",), 0.8)), 0.8),
            Column((Cell(("performance", "telemetry"), 1.2), Cell(("night",), 1.0)), 1.3),
            Column((Cell(("camera",), 1.0), Cell(("psf",), 1.15)), 1.0),
            Column((Cell(("mirror",), 1.0), Cell(("trends", "latency"), 1.15)), 0.9),
        ),
    ),
)


def workspace(name: str) -> Workspace:
    """A workspace by name; the last one if there is none of that name."""
    return next((one for one in WORKSPACES if one.name == name), WORKSPACES[-1])


def arrange_docks(window: QMainWindow, docks: dict[str, QDockWidget], plan: Workspace) -> None:
    """Arrange the docks of a workspace and hide the others."""
    for dock in docks.values():
        dock.setFloating(False)
        window.removeDockWidget(dock)
    columns = [
        (column, cells)
        for column in plan.columns
        if (cells := [cell for cell in column.cells if any(name in docks for name in cell.names)])
    ]
    column_docks = [_front_dock(docks, cells[0]) for _, cells in columns]
    for k, head in enumerate(column_docks):
        if k == 0:
            window.addDockWidget(Qt.DockWidgetArea.LeftDockWidgetArea, head)
        else:
            window.splitDockWidget(column_docks[k - 1], head, Qt.Orientation.Horizontal)
    for _, cells in columns:
        _stack_cells(window, docks, cells)
    for name in plan.panels:
        if name in docks:
            docks[name].show()
    for _, cells in columns:
        for cell in cells:
            _front_dock(docks, cell).raise_()
    if columns:
        _resize_docks(window, docks, columns, column_docks)
    for name in docks.keys() - set(plan.panels):
        # Position if the View menu shows it.
        window.addDockWidget(Qt.DockWidgetArea.RightDockWidgetArea, docks[name])
        docks[name].hide()


def arrange_tab_bars(window: QMainWindow, docks: dict[str, QDockWidget]) -> None:
    """Hide the tab bars of the previous arrangement, which Qt does not remove; titles are not cut off.

    Where there is no room for all tabs, arrows scroll them.
    """
    groups = [
        {one.windowTitle() for one in (dock, *window.tabifiedDockWidgets(dock)) if not one.isHidden()}
        for dock in docks.values()
    ]
    for bar in window.findChildren(QTabBar, options=Qt.FindChildOption.FindDirectChildrenOnly):
        if {bar.tabText(k) for k in range(bar.count())} not in groups:
            bar.hide()
        bar.setElideMode(Qt.TextElideMode.ElideNone)
        bar.setUsesScrollButtons(True)
        bar.setExpanding(False)


def visible_sizes(docks: Iterable[QDockWidget]) -> dict[QDockWidget, QSize]:
    """Sizes of the docks that are not hidden, floating or behind another tab."""
    return {dock: dock.size() for dock in docks if not (dock.isFloating() or dock.visibleRegion().isEmpty())}


def scale_docks(window: QMainWindow, before: QSize, sizes: dict[QDockWidget, QSize], area: QSize) -> None:
    """Scale docks from an area of the size ``before``; Qt takes what is missing from a few of them."""
    docks = list(sizes)
    for orientation, scale, pixels in (
        (Qt.Orientation.Horizontal, area.width() / before.width(), QSize.width),
        (Qt.Orientation.Vertical, area.height() / before.height(), QSize.height),
    ):
        window.resizeDocks(docks, [round(scale * pixels(sizes[dock])) for dock in docks], orientation)


def _front_dock(docks: dict[str, QDockWidget], cell: Cell) -> QDockWidget:
    return next(docks[name] for name in cell.names if name in docks)


def _stack_cells(window: QMainWindow, docks: dict[str, QDockWidget], cells: list[Cell]) -> None:
    fronts = [_front_dock(docks, cell) for cell in cells]
    # Qt does not split docks that are tabs.
    for above, front in pairwise(fronts):
        window.splitDockWidget(above, front, Qt.Orientation.Vertical)
    for cell, front in zip(cells, fronts, strict=True):
        for name in cell.names:
            if name in docks and docks[name] is not front:
                window.tabifyDockWidget(front, docks[name])


def _resize_docks(
    window: QMainWindow,
    docks: dict[str, QDockWidget],
    columns: list[tuple[Column, list[Cell]]],
    column_docks: list[QDockWidget],
) -> None:
    # The sum must not exceed the window's width, or the window grows.
    separators = (len(columns) - 1) * SEPARATOR_PX
    width = (window.width() - separators) / sum(column.share for column, _ in columns)
    window.resizeDocks(
        column_docks, [round(column.share * width) for column, _ in columns], Qt.Orientation.Horizontal
    )
    for _, cells in columns:
        height = window.height() / sum(cell.share for cell in cells)
        fronts = [_front_dock(docks, cell) for cell in cells]
        window.resizeDocks(fronts, [round(cell.share * height) for cell in cells], Qt.Orientation.Vertical)
