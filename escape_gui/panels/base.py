"""Base class of the panels."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, ClassVar

from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QLabel, QStackedLayout, QVBoxLayout, QWidget

from escape_gui.client.availability import has_ended
from escape_gui.client.session import Session
from escape_gui.theme import Theme
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import DeviceHealth, Geometry, Phase, State

#: Placeholder of a panel whose data came from an engine that has died.
ENGINE_ENDED_TEXT = "No data: the engine has ended.\nClear the fault to start it again."


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """Theme and session of a window, shared by its panels."""

    theme: Theme
    session: Session


class _PanelStack(QStackedLayout):
    """Content or placeholder of a panel.

    Ignores the preferred height of wrapped text: the scroll area around the panel would scroll to provide
    it, although the minimum height is enough.
    """

    def hasHeightForWidth(self) -> bool:
        return False


@dataclass(frozen=True, slots=True, eq=False)
class ExportArray:
    """An array that a panel shows, for export."""

    #: One word; name of the FITS extension and part of the file name.
    name: str
    #: One or two dimensions.
    data: NDArray[Any]
    #: Unit of the values.
    unit: str = ""
    #: Headings of the columns of a table; empty for images.
    columns: tuple[str, ...] = ()


class Panel(QWidget):
    """Content of a dock. The window's timer calls :meth:`refresh_from` while the panel is visible.

    A subclass sets the class attributes, adds its widgets to :attr:`body` and overrides
    :meth:`on_state`, :meth:`on_sample`, :meth:`clear` and :meth:`export_arrays`.
    """

    #: One lower-case word: name of the dock, of the help page and of exported files.
    name: ClassVar[str]
    title: ClassVar[str]
    #: Title of the tab if the panel lies behind another one; default: the title.
    tab_title: ClassVar[str] = ""
    #: Two or three sentences on content and use.
    help: ClassVar[str]
    #: Streams to read; only new entries are passed to :meth:`on_sample`.
    streams: ClassVar[tuple[str, ...]] = ()
    #: Refresh rate.
    rate_hz: ClassVar[float] = 5.0
    #: Text shown before there are data: the reason, and what to do.
    placeholder: ClassVar[str] = ""
    #: Time without a new entry after which the data are stale; ``None``: never.
    stale_after_s: ClassVar[float | None] = None

    def __init__(self, context: Context) -> None:
        super().__init__()
        self.context = context
        self.setObjectName("panel")
        self.setAccessibleName(self.title)
        self.setAccessibleDescription(self.help)
        self.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        #: Layout for the widgets of the subclass.
        self.body = QVBoxLayout()
        self.body.setContentsMargins(8, 8, 8, 8)
        self.body.setSpacing(8)
        self._stack = _PanelStack(self)
        content = QWidget()
        content.setLayout(self.body)
        self._placeholder_label = QLabel(self.placeholder)
        self._placeholder_label.setObjectName("empty")
        self._placeholder_label.setWordWrap(True)
        self._placeholder_label.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self._placeholder_label.setContentsMargins(24, 8, 24, 8)
        self._stack.addWidget(content)
        self._stack.addWidget(self._placeholder_label)
        self._last_index: dict[str, int] = {}
        self._state_serial = self._engine_pid = -1
        self._last_sample_s = 0.0
        self.health = DeviceHealth.STALE
        #: Positions of the sub-apertures and actuators; empty before the sensor was measured.
        self.bench_geometry = Geometry()
        #: Set by subclasses: :meth:`redraw` is called at the end of the refresh.
        self.dirty = False
        self.show_placeholder(bool(self.placeholder))
        context.theme.changed.connect(self.apply_theme)
        context.session.changed.connect(self.reset)

    # ------------------------------------------------------------ called by the window
    def refresh_from(self, source: DataSource) -> None:
        """Process a new state and new entries of the streams."""
        state = source.state
        if state.engine_pid != self._engine_pid:
            self.reset()
            self._engine_pid = state.engine_pid
        if state.serial != self._state_serial:
            self._state_serial = state.serial
            self.on_state(state)
        for stream in self.streams:
            sample = source.latest(stream, self._last_index.get(stream, -1))
            if sample is not None:
                self._last_index[stream] = sample.index
                self._last_sample_s = time.monotonic()
                self.show_placeholder(False)
                self.on_sample(stream, sample)
        if self.streams and self.shows_placeholder and has_ended(state):
            self.show_placeholder(True, ENGINE_ENDED_TEXT)
        geometry = source.geometry()
        if geometry is not self.bench_geometry:
            self.bench_geometry = geometry
            self.on_geometry()
        self.tick(source)
        if self.dirty:
            self.dirty = False
            self.redraw()
        self.health = self._assess_health(source, state)

    def _assess_health(self, source: DataSource, state: State) -> DeviceHealth:
        if not source.connected:
            return DeviceHealth.LOST
        if state.phase is Phase.FAULT:
            return DeviceHealth.FAULT
        limit = self.stale_after_s
        live = self.context.session.live
        if live and limit is not None and time.monotonic() - self._last_sample_s > limit:
            return DeviceHealth.STALE
        return DeviceHealth.OK

    def reset(self) -> None:
        """Discard all data: the source or its engine was replaced."""
        self._last_index.clear()
        self._state_serial = self._engine_pid = -1
        self._last_sample_s = 0.0
        self.bench_geometry = Geometry()
        self.on_geometry()
        self.clear()
        self.show_placeholder(bool(self.placeholder))

    def show_placeholder(self, placeholder: bool, why: str | None = None) -> None:
        """Show the placeholder (``why`` replaces its text) or the content."""
        if why is not None:
            self._placeholder_label.setText(why)
        elif placeholder:
            self._placeholder_label.setText(self.placeholder)
        self._stack.setCurrentIndex(1 if placeholder else 0)

    @property
    def shows_placeholder(self) -> bool:
        """Whether the placeholder is shown."""
        return self._stack.currentIndex() == 1

    # ------------------------------------------------------------ for subclasses
    def on_state(self, state: State) -> None:
        """Process a new state."""

    def on_sample(self, stream: str, sample: Sample) -> None:
        """Process a new entry of a stream."""

    def on_geometry(self) -> None:
        """Process a new :attr:`bench_geometry`."""

    def tick(self, source: DataSource) -> None:
        """Process everything else, such as the log; called at each refresh, after the samples."""

    def redraw(self) -> None:
        """Draw data that have changed, see :attr:`dirty`."""

    def clear(self) -> None:
        """Discard the data of the previous source."""

    def apply_theme(self) -> None:
        """Update colours and fonts."""

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """Arrays for CSV and FITS; empty: only PNG can be exported."""
        return ()
