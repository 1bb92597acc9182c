"""Main window: dock panels in three workspaces below a header, and the implementation of the actions."""

from __future__ import annotations

import base64
import logging
from collections.abc import Callable, Sequence
from datetime import datetime
from functools import partial
from pathlib import Path

from PySide6.QtCore import QByteArray, QPoint, QRect, QSize, Qt, QTimer, Signal
from PySide6.QtGui import QAction, QCloseEvent, QKeySequence, QResizeEvent
from PySide6.QtWidgets import (
    QApplication,
    QDockWidget,
    QLabel,
    QMainWindow,
    QMenuBar,
    QTabBar,
    QTabWidget,
    QWidget,
)

from escape_gui.client.alarms import LimitMonitor
from escape_gui.client.availability import tooltip
from escape_gui.client.connection import CLIENT_NAME
from escape_gui.client.session import Session
from escape_gui.panels import PANELS
from escape_gui.panels.base import Context, Panel
from escape_gui.panels.camera import CameraPanel
from escape_gui.panels.loop import LoopPanel
from escape_gui.panels.mirror import MirrorPanel
from escape_gui.panels.modes import ModesPanel
from escape_gui.panels.psf import PsfPanel
from escape_gui.panels.telemetry import TelemetryPanel
from escape_gui.replay.playback import PlaybackBar, RecordingOpener
from escape_gui.replay.source import ReplaySource
from escape_gui.settings import Settings, save_settings
from escape_gui.theme import Theme
from escape_gui.widgets.controls import Level, Overlay, column
from escape_gui.window.actions import ACTIONS, MENUS, format_shortcuts, help_page, keyboard_table
from escape_gui.window.alarm_dialog import AlarmDialog
from escape_gui.window.camera_dialog import CameraDialog
from escape_gui.window.closing import CloseQuestion, is_busy
from escape_gui.window.connect_dialog import ConnectDialog
from escape_gui.window.docks import (
    WORKSPACES,
    Dock,
    arrange_docks,
    arrange_tab_bars,
    scale_docks,
    visible_sizes,
    workspace,
)
from escape_gui.window.export import Exporter
from escape_gui.window.header import (
    AlarmBanner,
    BannerStack,
    ControlBanner,
    FaultBanner,
    FrozenBanner,
    HeaderBar,
    ServerBanner,
)
from escape_gui.window.notifications import NotificationBar, StateNotifier
from escape_gui.window.offsets_dialog import OffsetsDialog
from escape_gui.window.recording_browser import RecordingBrowser
from escape_gui.window.run_browser import RunBrowser
from escape_gui.window.update_timer import UpdateTimer
from escape_hw.errors import StorageError
from escape_hw.remote.state import State

log = logging.getLogger(__name__)
#: Version of the dock arrangement that Qt stores; layouts of other versions are discarded.
LAYOUT_VERSION = 4
#: Least width and height of a window in which the panels are arranged as on a large screen, pixels at the
#: normal size of the fonts.
_LARGE_PX = (2000, 1050)
#: Least width and height of a window that is large now.
_LEAST_PX = (800, 500)
#: Room that is left for the frame of the window manager.
_FRAME = QSize(8, 32)
#: Width of the coloured frame of a recorded run, and offset of its window, pixels.
_REPLAY_FRAME_PX, _REPLAY_OFFSET_PX = 5, 64
#: Workspace in which recorded runs are opened.
REPLAY_WORKSPACE = "calibrate"


class MainWindow(QMainWindow):
    """Window on one data source, whose session it does not close.

    The settings are saved into the file ``settings_path``, if given, on closing.
    """

    #: The window has been closed.
    closed = Signal()

    def __init__(
        self,
        session: Session,
        settings: Settings,
        settings_path: Path | None = None,
        panels: Sequence[type[Panel]] = PANELS,
    ) -> None:
        super().__init__()
        self._settings, self._settings_path = settings, settings_path
        self.context = Context(Theme(settings.theme, settings.font_scale), session)
        theme = self.context.theme
        theme.apply()
        theme.changed.connect(self._resize_tabs)
        self._allow_docks()
        self.actions_by_name = self._make_actions()
        self.header = HeaderBar(
            self.context, self.actions_by_name["open_loop"], self.actions_by_name["flatten"]
        )
        self._make_banners()
        self.tabs = self._make_tabs()
        self.panels = {kind.name: kind(self.context) for kind in panels}
        self.docks = {name: self._make_dock(panel) for name, panel in self.panels.items()}
        self._make_header()
        self._status_labels = {name: QLabel() for name in ("busy", "saved", "recording", "disk")}
        self.notifications = NotificationBar(theme)
        self._fill_status_bar()
        self.overlay = Overlay(self, theme)
        self.state_notifier = StateNotifier(self.notifications)
        self.exporter = Exporter(
            self, session, self.notifications, lambda path: self._set_status("saved", f"saved {path.name}")
        )
        self.update_timer = UpdateTimer(session, self.panels.values(), self.refresh)
        self.playback_bar = PlaybackBar(session)
        self.addToolBar(Qt.ToolBarArea.BottomToolBarArea, self.playback_bar)
        self._make_dialogs()
        self._connect_browsers()
        self._connect_panels()
        self._connect_session()
        #: Windows in which recorded runs were opened from this one.
        self.replay_windows: list[MainWindow] = []
        #: Whether this window started the server, and whether that server goes on without the window.
        self.started_server = self.leave_server = False
        #: Open question before closing.
        self.close_question: CloseQuestion | None = None
        self._may_close = False
        self.handlers = self._make_handlers()
        self.workspace = workspace(settings.workspace)
        self._is_large, self._layout = False, QByteArray()
        #: Size of the dock area and of the docks by layout, to scale the layout to another size.
        self._dock_sizes: dict[str, tuple[QSize, dict[QDockWidget, QSize]]] = {}
        self._restore()
        # A window that is large with small fonts may not be with large ones.
        theme.changed.connect(self._change_layout)

    # ------------------------------------------------------------ construction
    def _allow_docks(self) -> None:
        self.setDockNestingEnabled(True)
        self.setDockOptions(
            QMainWindow.DockOption.AnimatedDocks
            | QMainWindow.DockOption.AllowNestedDocks
            | QMainWindow.DockOption.AllowTabbedDocks
        )
        self.setTabPosition(Qt.DockWidgetArea.AllDockWidgetAreas, QTabWidget.TabPosition.North)

    def _make_banners(self) -> None:
        context, actions, settings = self.context, self.actions_by_name, self._settings
        self.fault_banner = FaultBanner(context, actions["clear_fault"])
        self.alarms = LimitMonitor(settings.alarms, self._log_alarm)
        self.alarm_banner = AlarmBanner(context, actions["acknowledge"])
        self.alarm_dialog = AlarmDialog(self, settings)
        # At once: they must also be there in the window after one that was killed.
        self.alarm_dialog.accepted.connect(self._save_settings)
        self.frozen_banner = FrozenBanner(context, actions["freeze"])
        self.control_banner = ControlBanner(context, actions["take_control"])
        self.server_banner = ServerBanner(context)

    def _make_dialogs(self) -> None:
        session, theme = self.context.session, self.context.theme
        self.replay = RecordingOpener(self, session)
        self.run_browser, self.recording_browser = RunBrowser(self, session), RecordingBrowser(self, session)
        self.camera_dialogs = {name: CameraDialog(self, session, theme, name) for name in ("wfs", "science")}
        self.offsets_dialog = OffsetsDialog(self, session, theme)
        self.connect_dialog = ConnectDialog(self, theme)

    def _fill_status_bar(self) -> None:
        self.statusBar().addWidget(self.notifications, 1)
        for label in self._status_labels.values():
            self.statusBar().addPermanentWidget(label)

    def _connect_browsers(self) -> None:
        """Connect what opens and shows runs and recordings."""
        self.replay.opened.connect(self.show_recording)
        self.replay.failed.connect(
            lambda why: self.notifications.show_message(Level.ERROR, "Cannot be opened", why)
        )
        self.run_browser.replay_requested.connect(self.replay.open)
        loop, telemetry = self.panels.get(LoopPanel.name), self.panels.get(TelemetryPanel.name)
        if isinstance(loop, LoopPanel):
            loop.load_button.clicked.connect(self.run_browser.open_list)
            self.run_browser.matrix_loaded.connect(lambda product: loop.choose_matrix(product.name))
        if isinstance(telemetry, TelemetryPanel):
            telemetry.browse_button.clicked.connect(self.recording_browser.open_list)
            self.recording_browser.opened.connect(telemetry.open_recording)

    def _connect_session(self) -> None:
        """Show failed and pending requests."""
        session = self.context.session
        session.failed.connect(
            lambda what, why: self.notifications.show_message(Level.ERROR, f"Could not {what}", why)
        )
        session.pending_changed.connect(
            lambda n: self._set_status("busy", f"{n} request(s) pending" if n else "")
        )

    def _connect_panels(self) -> None:
        """Connect panels with dialogs and with each other."""
        for panel in self.panels.values():
            if isinstance(panel, CameraPanel | PsfPanel):
                panel.settings_requested.connect(lambda name: self.camera_dialogs[name].open_settings())
        mirror, modes = self.panels.get(MirrorPanel.name), self.panels.get(ModesPanel.name)
        if isinstance(mirror, MirrorPanel):
            mirror.offsets_requested.connect(self.offsets_dialog.open_offsets)
        if isinstance(mirror, MirrorPanel) and isinstance(modes, ModesPanel):
            modes.mosaic.chosen.connect(mirror.choose_mode)

    def _make_actions(self) -> dict[str, QAction]:
        actions = {}
        for one in ACTIONS:
            action = QAction(one.text, self)
            action.setObjectName(one.name)
            action.setShortcuts([QKeySequence(key) for key in one.keys])
            action.setShortcutContext(Qt.ShortcutContext.WindowShortcut)
            action.triggered.connect(lambda _=False, name=one.name: self.handlers[name]())
            self.addAction(action)
            actions[one.name] = action
        return actions

    def _make_handlers(self) -> dict[str, Callable[[], object]]:
        """What each action of :data:`~escape_gui.window.actions.ACTIONS` does, by its name."""
        session = self.context.session
        ask = session.ask
        return {
            "connect": self.connect_dialog.open_list,
            "open_product": self.replay.ask_product,
            "runs": self.run_browser.open_list,
            "open_run": self.replay.ask_run,
            "save_png": lambda: self.exporter.panel("png", self.focused_panel()),
            "save_csv": lambda: self.exporter.panel("csv", self.focused_panel()),
            "save_fits": lambda: self.exporter.panel("fits", self.focused_panel()),
            "save_window": self.exporter.window,
            "quit": self.close,
            **{f"workspace_{one.name}": partial(self.show_workspace, one.name) for one in WORKSPACES},
            "reset_layout": self.reset_layout,
            "next_panel": lambda: self.focus_panel(+1),
            "previous_panel": lambda: self.focus_panel(-1),
            "freeze": self.toggle_freeze,
            "theme": self.toggle_theme,
            "larger": lambda: self.context.theme.step_scale(+1),
            "smaller": lambda: self.context.theme.step_scale(-1),
            "normal": lambda: self.context.theme.step_scale(0),
            "open_loop": lambda: ask("open the loop", lambda server: server.open_loop(), urgent=True),
            "flatten": lambda: ask("flatten the mirror", lambda server: server.flatten(), urgent=True),
            "abort": session.abort,
            "pause": session.toggle_pause,
            "take_control": self.take_control,
            "give_back": lambda: ask("release control", lambda server: server.release()),
            "record": self.toggle_recording,
            "clear_fault": lambda: ask("clear the fault", lambda server: server.clear_fault()),
            "alarms": self.alarm_dialog.open_settings,
            "acknowledge": self.alarms.acknowledge,
            "help_panel": self.show_panel_help,
            "keys": self.toggle_keyboard_table,
        }

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
                submenu = menu.addMenu("Sho&w")
                for dock in self.docks.values():
                    submenu.addAction(dock.toggleViewAction())
        bar.setCornerWidget(self.tabs, Qt.Corner.TopRightCorner)
        top = self._top = QWidget()
        top.setObjectName("header")
        top.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        banners = (
            self.fault_banner, self.alarm_banner, self.control_banner, self.frozen_banner, self.server_banner,
        )  # fmt: skip
        self._banners = BannerStack(banners)
        column(bar, self.header, self._banners, parent=top, spacing=0)
        self.setMenuWidget(top)

    # ------------------------------------------------------------ layout
    def _restore(self) -> None:
        self.resize(1280, 800)
        if self._settings.geometry:
            self.restoreGeometry(_bytes(self._settings.geometry))
        self._apply_layout()
        self.tabs.setCurrentIndex(WORKSPACES.index(self.workspace))
        self.setFocus()

    def fit_to_screen(self, available: QRect) -> None:
        """Make the window fit the available part of a screen, with its frame and its last line."""
        self.resize(self.size().boundedTo(available.size() - _FRAME))
        last = available.bottomRight() - QPoint(self.width(), self.height())
        self.move(
            max(available.left(), min(self.x(), last.x())), max(available.top(), min(self.y(), last.y()))
        )

    def _apply_layout(self) -> None:
        self._is_large = self._fits_large_layout
        # The many columns of a large window do not keep it large; a smaller one gets its own layout.
        self.setMinimumSize(*(_LEAST_PX if self._is_large else (0, 0)))
        stored = self._settings.layouts.get(self._layout_name)
        docks: dict[str, QDockWidget] = dict(self.docks)
        size = self.size()
        if stored is None or not self.restoreState(_bytes(stored), LAYOUT_VERSION):
            arrange_docks(self, docks, self.workspace.arranged(self._is_large))
        elif self._layout_name in self._dock_sizes:
            scale_docks(self, *self._dock_sizes[self._layout_name], self._dock_area)
        self.resize(size)
        arrange_tab_bars(self, docks)
        if self.isVisible() and not (self.isMaximized() or self.isFullScreen()):
            # The layout of a larger window must not enlarge this one when Qt calculates its least size later.
            QTimer.singleShot(0, self, lambda: self.resize(self.size().boundedTo(size)))
        # Docks that were shown again lie above everything else.
        self.overlay.raise_()
        self._layout = self.saveState(LAYOUT_VERSION)

    @property
    def _fits_large_layout(self) -> bool:
        least = QSize(*map(self.context.theme.pixels, _LARGE_PX))
        return self.width() >= least.width() and self.height() >= least.height()

    @property
    def _layout_name(self) -> str:
        """Name of the present layout in the settings; that of a large window is another one."""
        return f"{self.workspace.name}-large" if self._is_large else self.workspace.name

    def _change_layout(self) -> None:
        """Arrange the panels anew when the window has become large, or is no longer."""
        if self._fits_large_layout != self._is_large:
            focused = self.focusWidget()
            self._store_layout()
            self._apply_layout()
            # Qt passes the focus of a panel that is moved to another widget, which would get the next keys.
            if focused is not None and not focused.visibleRegion().isEmpty():
                focused.setFocus()
            else:
                self.setFocus()

    def resizeEvent(self, event: QResizeEvent) -> None:
        super().resizeEvent(event)
        self._banners.fit()
        QTimer.singleShot(0, self, self._change_layout)

    def show_workspace(self, name: str) -> None:
        """Save the layout of this workspace and change to another one."""
        if name == self.workspace.name:
            return
        self._store_layout()
        self.workspace = workspace(name)
        self._apply_layout()
        self.tabs.setCurrentIndex(WORKSPACES.index(self.workspace))
        # Otherwise Qt passes the focus of a panel that is hidden now to the next widget, whatever it is.
        self.setFocus()

    def reset_layout(self) -> None:
        self._settings.layouts.pop(self._layout_name, None)
        self._apply_layout()

    def _note_layout(self) -> None:
        """Remember the layout while the window has the size for it: panels are squeezed when it shrinks."""
        if self._fits_large_layout == self._is_large:
            self._layout = self.saveState(LAYOUT_VERSION)
            self._dock_sizes[self._layout_name] = (self._dock_area, visible_sizes(self.docks.values()))

    @property
    def _dock_area(self) -> QSize:
        """Size of the window without header and last line."""
        return self.size() - QSize(0, self._top.height() + self.statusBar().height())

    def _store_layout(self) -> None:
        self._note_layout()
        self._settings.layouts[self._layout_name] = _text(self._layout)

    def focus_panel(self, step: int) -> None:
        """Move the focus by ``step`` visible panels."""
        visible = [name for name, dock in self.docks.items() if not dock.visibleRegion().isEmpty()]
        if not visible:
            return
        now = self.focused_panel()
        k = visible.index(now.name) + step if now is not None and now.name in visible else 0
        panel = self.panels[visible[k % len(visible)]]
        panel.setFocus(Qt.FocusReason.TabFocusReason)
        if not panel.hasFocus():
            panel.focusNextChild()

    def focused_panel(self) -> Panel | None:
        """The panel that has the focus, if any."""
        widget = QApplication.focusWidget()
        while widget is not None and not isinstance(widget, Panel):
            widget = widget.parentWidget()
        return widget

    # ------------------------------------------------------------ state, five times a second
    def refresh(self) -> None:
        """Update header, actions, dock titles, notifications and status bar from the newest state."""
        session = self.context.session
        now = session.request_context
        state = now.state
        if now.live and now.connected:
            session.history.update(state)
            self.alarms.update(state)
        self.alarm_banner.show_alarms(self.alarms.unacknowledged, muted=self._settings.alarms_muted)
        self.header.show_state(state, connected=now.connected, live=now.live, mine=now.may_write)
        self.fault_banner.show_state(state)
        self.control_banner.show_state(state, offered=now.connected and now.live and not now.may_write)
        self._banners.fit()
        for one in ACTIONS:
            reason = one.unavailable(now)
            action = self.actions_by_name[one.name]
            action.setEnabled(not reason)
            keys = f" ({format_shortcuts(one.keys)})" if one.keys and not reason else ""
            action.setToolTip(tooltip(f"{one.tip}{keys}", reason))
        dialogs: tuple[CameraDialog | OffsetsDialog | RunBrowser | RecordingBrowser, ...] = (
            *self.camera_dialogs.values(), self.offsets_dialog, self.run_browser, self.recording_browser,
        )  # fmt: skip
        for dialog in dialogs:
            if dialog.isVisible():
                dialog.update_buttons()
        for dock in self.docks.values():
            dock.show_health()
        self.state_notifier.update(state, connected=now.connected, mine=now.may_write)
        self._note_layout()
        telemetry = state.recording
        self._set_status(
            "recording",
            f"recording {telemetry.size / 1e6:,.1f} MB, {telemetry.dropped} dropped"
            if telemetry.recording
            else "",
        )
        self._set_status("disk", f"{state.disk.free_gb:.1f} GB free" if state.disk.folder else "")
        self._show_source(state)

    def _show_source(self, state: State) -> None:
        """Title, and for a recorded run a frame in the colour of the banner."""
        source = self.context.session.source
        if replay := isinstance(source, ReplaySource):
            title = f"REPLAY · {source.path.name} · ESCAPE"
        else:
            title = f"ESCAPE · {state.system}" if state.system else "ESCAPE"
        self.setWindowTitle(title)
        frame = f"MainWindow {{ background: {self.context.theme.colours.replay}; }}" if replay else ""
        if frame != self.styleSheet():
            self.setStyleSheet(frame)
            self.setContentsMargins(*(4 * [_REPLAY_FRAME_PX if replay else 0]))

    def _set_status(self, name: str, text: str) -> None:
        self._status_labels[name].setText(text)

    # ------------------------------------------------------------ actions
    def take_control(self) -> None:
        """Request control, from the client that has it if there is one."""
        held = self.context.session.source.state.lease is not None
        self.context.session.ask("take control", lambda server: server.acquire(take_over=held))

    def _log_alarm(self, text: str) -> None:
        """Add an alarm to the night log, unless another window has control and does."""
        session = self.context.session
        lease = session.source.state.lease
        if session.may_write or lease is None or lease.name != CLIENT_NAME:
            session.ask("log the alarm", lambda server: server.add_note(text, kind="alarm"), quiet=True)

    def toggle_recording(self) -> None:
        on = not self.context.session.source.state.recording.recording
        self.context.session.ask(
            "record telemetry" if on else "stop recording", lambda server: server.record(on)
        )

    def toggle_theme(self) -> None:
        self.context.theme.set_palette("light" if self.context.theme.palette_name == "dark" else "dark")

    def toggle_freeze(self) -> None:
        """Freeze the panels or resume them; header and safety buttons never freeze."""
        self.update_timer.frozen = not self.update_timer.frozen
        self.frozen_banner.show_frozen(f"{datetime.now():%H:%M:%S}" if self.update_timer.frozen else "")

    def toggle_keyboard_table(self) -> None:
        if self.overlay.isVisible():
            self.overlay.hide()
        else:
            self.overlay.open("Keyboard", keyboard_table())

    def show_panel_help(self, panel: Panel | None = None) -> None:
        """Show the help page of a panel, by default of the one with the focus."""
        panel = panel or self.focused_panel()
        if panel is None:
            self.toggle_keyboard_table()
        else:
            self.overlay.open(panel.title, help_page(panel), markdown=True)

    def show_recording(self, source: ReplaySource) -> None:
        """Show a recorded run, in a window of its own if this one is connected to a server.

        The safety buttons of a window on a bench must remain those of the bench.
        """
        session = self.context.session
        if session.control is None:
            session.set_source(source, None)
            self.show_workspace(REPLAY_WORKSPACE)
            return
        kinds = [type(panel) for panel in self.panels.values()]
        other = MainWindow(Session(), self._settings.model_copy(deep=True), None, kinds)
        self.replay_windows.append(other)
        other.closed.connect(partial(self._forget_replay_window, other))
        other.show_recording(source)
        # It has no server, and needs none: this window stays on its own.
        other.actions_by_name["connect"].setVisible(False)
        other.update_timer.start()
        # The bench stays visible beside the recorded run.
        other.resize(round(0.85 * self.width()), round(0.85 * self.height()))
        other.move(self.pos() + QPoint(_REPLAY_OFFSET_PX, _REPLAY_OFFSET_PX))
        other.show()

    def _forget_replay_window(self, other: MainWindow) -> None:
        """Release a recorded run with its window, which may hold gigabytes."""
        self.replay_windows.remove(other)
        other.context.session.close()
        other.deleteLater()

    def close_without_question(self) -> None:
        """Close; a server that this window started goes on if something runs there."""
        self.leave_server = is_busy(self.context.session.source.state)
        self._may_close = True
        self.close()

    def _answer_close_question(self, leave_server: bool) -> None:
        self.leave_server, self._may_close = leave_server, True
        self.close()

    def _may_close_now(self) -> bool:
        """Whether nothing has to be asked before closing; otherwise ask."""
        session = self.context.session
        state = session.source.state
        if self._may_close or session.control is None or not session.source.connected:
            return True
        if not (self.started_server or is_busy(state)):
            return True
        if self.close_question is None:
            question = CloseQuestion(self, state, mine=session.may_write, started_server=self.started_server)
            question.answered.connect(self._answer_close_question)
            question.finished.connect(self._forget_close_question)
            self.close_question = question
            question.open()
        return False

    def _forget_close_question(self) -> None:
        if self.close_question is not None:
            self.close_question.deleteLater()
            self.close_question = None

    def closeEvent(self, event: QCloseEvent) -> None:
        """Save settings and layout; ask first while something runs, or if this window started the server."""
        if not self._may_close_now():
            event.ignore()
            return
        self.update_timer.stop()
        self.replay.close()
        self.run_browser.hide()
        for other in [*self.replay_windows]:
            other.close()
        self._store_layout()
        theme, settings = self.context.theme, self._settings
        settings.geometry = _text(self.saveGeometry())
        settings.theme, settings.font_scale = theme.palette_name, theme.scale
        settings.workspace = self.workspace.name
        self._save_settings()
        super().closeEvent(event)
        self.closed.emit()

    def _save_settings(self) -> None:
        if self._settings_path is not None:
            try:
                save_settings(self._settings_path, self._settings)
            except StorageError as error:
                log.warning("settings not saved: %s", error)


def _bytes(text: str) -> QByteArray:
    try:
        return QByteArray(base64.b64decode(text, validate=True))
    except ValueError:
        return QByteArray()


def _text(content: QByteArray) -> str:
    return base64.b64encode(content.data()).decode()
