"""The window: docks in three workspaces under one band, and what the actions do."""

from __future__ import annotations

import base64
import logging
from collections.abc import Callable, Sequence
from pathlib import Path

from PySide6.QtCore import QByteArray, Qt
from PySide6.QtGui import QAction, QCloseEvent, QKeySequence
from PySide6.QtWidgets import (
    QApplication,
    QDockWidget,
    QLabel,
    QMainWindow,
    QMenuBar,
    QTabBar,
    QTabWidget,
    QVBoxLayout,
    QWidget,
)

from escape_gui.client.availability import RequestContext
from escape_gui.client.session import ServerControl, Session
from escape_gui.panels import PANELS
from escape_gui.panels.base import Context, Panel
from escape_gui.replay.opener import RecordingOpener
from escape_gui.settings import Settings, save_settings
from escape_gui.theme import Theme
from escape_gui.widgets.controls.overlay import Overlay
from escape_gui.widgets.controls.status_indicator import Level
from escape_gui.window.actions import ACTIONS, MENUS
from escape_gui.window.dock import Dock
from escape_gui.window.export import Exporter
from escape_gui.window.header import FaultBanner, HeaderBar
from escape_gui.window.help_pages import format_shortcuts, help_page, keyboard_table
from escape_gui.window.notifications import NotificationBar, StateNotifier
from escape_gui.window.update_timer import UpdateTimer
from escape_gui.window.workspaces import WORKSPACES, arrange_docks, hide_orphan_tab_bars, workspace
from escape_hw.errors import StorageError

log = logging.getLogger(__name__)
#: Version of the arrangement Qt stores; layouts of another one are dropped.
LAYOUT_VERSION = 3


class MainWindow(QMainWindow):
    """One window on one source.

    Parameters
    ----------
    session
        Data and requests; the window does not close it.
    settings
        What is remembered.
    store
        Where to remember it; ``None``: nowhere.
    panels
        Kinds of panels to show.
    """

    def __init__(
        self,
        session: Session,
        settings: Settings,
        settings_path: Path | None = None,
        panels: Sequence[type[Panel]] = PANELS,
    ) -> None:
        super().__init__()
        self._settings, self._store = settings, settings_path
        self.context = Context(Theme(settings.theme, settings.font_scale), session)
        self.context.theme.apply()
        self.context.theme.changed.connect(self._resize_tabs)
        self.setDockNestingEnabled(True)
        self.setDockOptions(
            QMainWindow.DockOption.AnimatedDocks
            | QMainWindow.DockOption.AllowNestedDocks
            | QMainWindow.DockOption.AllowTabbedDocks
        )
        self.setTabPosition(Qt.DockWidgetArea.AllDockWidgetAreas, QTabWidget.TabPosition.North)
        self.actions_by_name = self._make_actions()
        self.header = HeaderBar(
            self.context, self.actions_by_name["open_loop"], self.actions_by_name["flatten"]
        )
        self.fault_banner = FaultBanner(self.context, self.actions_by_name["clear_fault"])
        self.tabs = self._make_tabs()
        self.panels = {kind.name: kind(self.context) for kind in panels}
        self.docks = {name: self._make_dock(panel) for name, panel in self.panels.items()}
        self._make_header()
        self._status_labels = {name: QLabel() for name in ("frozen", "busy", "saved", "recording", "disk")}
        self.notifications = NotificationBar(self.context.theme)
        self.statusBar().addWidget(self.notifications, 1)
        for label in self._status_labels.values():
            self.statusBar().addPermanentWidget(label)
        self.overlay = Overlay(self, self.context.theme)
        self.state_notifier = StateNotifier(self.notifications)
        self.exporter: Exporter = Exporter(self)
        self.update_timer = UpdateTimer(session, self.panels.values(), self.refresh)
        self.replay: RecordingOpener = RecordingOpener(
            self, lambda: MainWindow(Session(), settings.model_copy(deep=True), None, panels)
        )
        session.failed.connect(
            lambda what, why: self.notifications.show_message(Level.ERROR, f"Could not {what}", why)
        )
        session.pending_changed.connect(
            lambda n: self.set_status_text("busy", f"{n} request(s) under way" if n else "")
        )
        self.workspace = workspace(settings.workspace)
        self._restore()

    # ------------------------------------------------------------ building
    def _make_actions(self) -> dict[str, QAction]:
        made = {}
        for one in ACTIONS:
            action = QAction(one.text, self)
            action.setObjectName(one.name)
            action.setShortcuts([QKeySequence(key) for key in one.keys])
            action.setShortcutContext(Qt.ShortcutContext.WindowShortcut)
            action.triggered.connect(lambda _=False, one=one: one.run(self))
            self.addAction(action)
            made[one.name] = action
        return made

    def _make_tabs(self) -> QTabBar:
        tabs = QTabBar()
        tabs.setAccessibleName("Workspaces")
        tabs.setExpanding(False)
        tabs.setDrawBase(False)
        tabs.setUsesScrollButtons(False)
        for one in WORKSPACES:
            tabs.setTabToolTip(tabs.addTab(one.title), f"{one.purpose}.")
        tabs.tabBarClicked.connect(lambda k: self.show_workspace(WORKSPACES[k].name) if k >= 0 else None)
        tabs.currentChanged.connect(lambda k: self.show_workspace(WORKSPACES[k].name))
        return tabs

    def _resize_tabs(self) -> None:
        """Another look has wider or narrower words."""
        self.tabs.setMinimumWidth(self.tabs.sizeHint().width())
        self.tabs.updateGeometry()

    def _make_dock(self, panel: Panel) -> Dock:
        dock = Dock(panel, self.context.theme, self)
        dock.save_requested.connect(lambda name, kind: self.exporter.panel(kind, self.panels[name]))
        dock.help_requested.connect(lambda name: self.show_panel_help(self.panels[name]))
        return dock

    def _make_header(self) -> None:
        bar = QMenuBar()
        for title in MENUS:
            menu = bar.addMenu(title)
            for one in ACTIONS:
                if one.menu == title:
                    menu.addAction(self.actions_by_name[one.name])
            if title == "&View":
                menu.addSeparator()
                shown = menu.addMenu("Sho&w")
                for dock in self.docks.values():
                    shown.addAction(dock.toggleViewAction())
        bar.setCornerWidget(self.tabs, Qt.Corner.TopRightCorner)
        top = QWidget()
        column = QVBoxLayout(top)
        column.setContentsMargins(0, 0, 0, 0)
        column.setSpacing(0)
        for widget in (bar, self.header, self.fault_banner):
            column.addWidget(widget)
        self.setMenuWidget(top)

    # ------------------------------------------------------------ layout
    def _restore(self) -> None:
        self.resize(1280, 800)
        if self._settings.geometry:
            self.restoreGeometry(_bytes(self._settings.geometry))
        self._apply_layout()
        self.tabs.setCurrentIndex(WORKSPACES.index(self.workspace))
        self.setFocus()

    def _apply_layout(self) -> None:
        stored = self._settings.layouts.get(self.workspace.name)
        docks: dict[str, QDockWidget] = dict(self.docks)
        size = self.size()
        if stored is None or not self.restoreState(_bytes(stored), LAYOUT_VERSION):
            arrange_docks(self, docks, self.workspace)
        # A layout of a larger window must not make this one larger.
        self.resize(size)
        hide_orphan_tab_bars(self, docks)
        # Docks that were shown anew lie over everything.
        self.overlay.raise_()

    def show_workspace(self, name: str) -> None:
        """Change to another workspace, each as it was left."""
        if name == self.workspace.name:
            return
        self._store_layout()
        self.workspace = workspace(name)
        self._apply_layout()
        self.tabs.setCurrentIndex(WORKSPACES.index(self.workspace))

    def reset_layout(self) -> None:
        """Put this workspace's panels back in place."""
        self._settings.layouts.pop(self.workspace.name, None)
        self._apply_layout()

    def _store_layout(self) -> None:
        self._settings.layouts[self.workspace.name] = _text(self.saveState(LAYOUT_VERSION))

    def focus_panel(self, step: int) -> None:
        """Give the focus to the next visible panel."""
        seen = [name for name, dock in self.docks.items() if not dock.visibleRegion().isEmpty()]
        if not seen:
            return
        now = self.focused_panel()
        k = seen.index(now.name) + step if now is not None and now.name in seen else 0
        panel = self.panels[seen[k % len(seen)]]
        panel.setFocus(Qt.FocusReason.TabFocusReason)
        if not panel.hasFocus():
            panel.focusNextChild()

    def focused_panel(self) -> Panel | None:
        """The panel that has the focus."""
        widget = QApplication.focusWidget()
        while widget is not None and not isinstance(widget, Panel):
            widget = widget.parentWidget()
        return widget

    # ------------------------------------------------------------ five times a second
    def refresh(self) -> None:
        """Bring band, actions and notes up to date."""
        session = self.context.session
        source, live = session.source, session.live
        state = source.state
        now = RequestContext(state, source.connected, live, session.may_write)
        self.header.show_state(state, connected=now.connected, live=live, mine=now.may_write)
        self.fault_banner.show_state(state)
        for one in ACTIONS:
            why = one.unavailable(now)
            action = self.actions_by_name[one.name]
            action.setEnabled(not why)
            keys = f" ({format_shortcuts(one.keys)})" if one.keys else ""
            action.setToolTip(f"{one.tip}{keys}" if not why else f"{one.tip} Not now: {why}.")
        for dock in self.docks.values():
            dock.show_health()
        self.state_notifier.update(state, connected=now.connected)
        written = state.recording
        self.set_status_text(
            "recording",
            f"recording {written.written} frames, {written.dropped} dropped" if written.recording else "",
        )
        self.set_status_text("disk", f"{state.disk.free_gb:.1f} GB free" if state.disk.folder else "")
        self.setWindowTitle(f"ESCAPE · {state.system}" if state.system else "ESCAPE")

    def set_status_text(self, name: str, text: str) -> None:
        """Change a note in the status bar: frozen, busy, saved, recording, disk."""
        self._status_labels[name].setText(text)

    # ------------------------------------------------------------ what actions do
    def ask(self, what: str, call: Callable[[ServerControl], object], *, urgent: bool = False) -> None:
        """Send a request whose answer nobody waits for."""
        requests = self.context.session.requests
        if requests is not None:
            requests.ask(what, call, urgent=urgent)

    def take_control(self) -> None:
        """Ask for the lease, from its holder if there is one."""
        held = self.context.session.source.state.lease is not None
        self.ask("take control", lambda server: server.acquire(take_over=held))

    def toggle_pause(self) -> None:
        """Halt the procedure or go on with it."""
        running = self.context.session.source.state.active_run
        if running is not None and running.paused:
            self.ask("go on", lambda server: server.resume())
        else:
            self.ask("pause", lambda server: server.pause())

    def toggle_recording(self) -> None:
        """Begin or end telemetry."""
        on = not self.context.session.source.state.recording.recording
        self.ask("record telemetry" if on else "stop recording", lambda server: server.record(on))

    def toggle_theme(self) -> None:
        """The other palette."""
        self.context.theme.set_palette("light" if self.context.theme.palette_name == "dark" else "dark")

    def step_font_scale(self, steps: int) -> None:
        """Larger or smaller letters; 0: the normal size."""
        self.context.theme.step_scale(steps)

    def toggle_freeze(self) -> None:
        """Hold the panels, or let them go on; band and safety buttons never freeze."""
        self.update_timer.frozen = not self.update_timer.frozen
        self.set_status_text("frozen", "Panels are frozen; X goes on" if self.update_timer.frozen else "")

    def toggle_keyboard_table(self) -> None:
        """Show the keys, or close them."""
        if self.overlay.isVisible():
            self.overlay.hide()
        else:
            self.overlay.open("Keyboard", keyboard_table())

    def show_panel_help(self, panel: Panel | None = None) -> None:
        """Show a panel's help page; without one, of the panel in focus."""
        panel = panel or self.focused_panel()
        if panel is None:
            self.toggle_keyboard_table()
        else:
            self.overlay.open(panel.title, help_page(panel), markdown=True)

    def closeEvent(self, event: QCloseEvent) -> None:
        """Remember the layout; the server goes on."""
        self.update_timer.stop()
        self.replay.close()
        self._store_layout()
        theme, settings = self.context.theme, self._settings
        settings.geometry = _text(self.saveGeometry())
        settings.theme, settings.font_scale = theme.palette_name, theme.scale
        settings.workspace = self.workspace.name
        if self._store is not None:
            try:
                save_settings(self._store, settings)
            except StorageError as error:
                log.warning("settings are not kept: %s", error)
        super().closeEvent(event)


def _bytes(text: str) -> QByteArray:
    try:
        return QByteArray(base64.b64decode(text, validate=True))
    except ValueError:
        return QByteArray()


def _text(content: QByteArray) -> str:
    return base64.b64encode(content.data()).decode()
