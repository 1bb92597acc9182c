"""What all panels have in common."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, ClassVar

from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QLabel, QStackedLayout, QVBoxLayout, QWidget

from escape_gui.client.session import Session
from escape_gui.theme import Theme
from escape_hw.remote.source import DataSource, Sample
from escape_hw.remote.state import DeviceHealth, Phase, State


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """What a panel works with beside its data."""

    theme: Theme
    session: Session


class _PanelStack(QStackedLayout):
    """Content, or the words that stand for it.

    Where a line wraps, a scroll area would give all that it would like and scroll, though it could do
    with less.
    """

    def hasHeightForWidth(self) -> bool:
        """The least height counts."""
        return False


@dataclass(frozen=True, slots=True, eq=False)
class ExportArray:
    """An array that a panel shows, for saving.

    Parameters
    ----------
    name
        One word; becomes the extension's name and part of a file's.
    data
        One or two dimensions.
    unit
        Unit of the values.
    columns
        Headings, one for each column of a table; empty for pictures.
    """

    name: str
    data: NDArray[Any]
    unit: str = ""
    columns: tuple[str, ...] = ()


class Panel(QWidget):
    """One dock's content. The window's timer calls :meth:`refresh_from`, only while the panel can be seen.

    A subclass sets the class attributes, puts its widgets into :attr:`body` and overrides
    :meth:`on_state`, :meth:`on_sample`, :meth:`clear` and :meth:`export_arrays`.
    """

    #: One lower-case word: the dock's name, the help page's, the part of a file name.
    name: ClassVar[str]
    title: ClassVar[str]
    #: What it shows and what to do with it, two or three sentences.
    help: ClassVar[str]
    #: Streams it reads; only entries not yet seen are handed on.
    streams: ClassVar[tuple[str, ...]] = ()
    #: How often it looks.
    rate_hz: ClassVar[float] = 5.0
    #: What stands in it before there is anything to show: why, and what to do next.
    placeholder: ClassVar[str] = ""
    #: Without a new entry for so long the data are stale; ``None``: they have no period.
    stale_after_s: ClassVar[float | None] = None

    def __init__(self, context: Context) -> None:
        super().__init__()
        self.context = context
        self.setObjectName("panel")
        self.setAccessibleName(self.title)
        self.setAccessibleDescription(self.help)
        self.setAttribute(Qt.WidgetAttribute.WA_StyledBackground)
        #: The subclass's widgets go in here.
        self.body = QVBoxLayout()
        self.body.setContentsMargins(8, 8, 8, 8)
        self.body.setSpacing(8)
        self._stack = _PanelStack(self)
        holder = QWidget()
        holder.setLayout(self.body)
        self._placeholder_label = QLabel(self.placeholder)
        self._placeholder_label.setObjectName("empty")
        self._placeholder_label.setWordWrap(True)
        self._placeholder_label.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self._placeholder_label.setContentsMargins(24, 8, 24, 8)
        self._stack.addWidget(holder)
        self._stack.addWidget(self._placeholder_label)
        self._last_index: dict[str, int] = {}
        self._state_serial = self._engine_pid = -1
        self._last_sample_s = 0.0
        self.health = DeviceHealth.STALE
        self.show_placeholder(bool(self.placeholder))
        context.theme.changed.connect(self.apply_theme)
        context.session.changed.connect(self.reset)

    # ------------------------------------------------------------ called by the window
    def refresh_from(self, source: DataSource) -> None:
        """Take what is new; costs next to nothing when nothing is."""
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
        self.tick(source)
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
        """Forget what was seen: another engine counts from the beginning."""
        self._last_index.clear()
        self._state_serial = self._engine_pid = -1
        self._last_sample_s = 0.0
        self.clear()
        self.show_placeholder(bool(self.placeholder))

    def show_placeholder(self, placeholder: bool, why: str | None = None) -> None:
        """Show the note of what to do next (``why`` instead of :attr:`placeholder`), or the content."""
        if why is not None:
            self._placeholder_label.setText(why)
        elif placeholder:
            self._placeholder_label.setText(self.placeholder)
        self._stack.setCurrentIndex(1 if placeholder else 0)

    @property
    def shows_placeholder(self) -> bool:
        """Whether the note is shown instead of the content."""
        return self._stack.currentIndex() == 1

    # ------------------------------------------------------------ for subclasses
    def on_state(self, state: State) -> None:
        """The state has changed."""

    def on_sample(self, stream: str, sample: Sample) -> None:
        """A stream has a new entry."""

    def tick(self, source: DataSource) -> None:
        """Once per pull, after state and samples: for what is neither, such as the log."""

    def clear(self) -> None:
        """Drop what belongs to the old source."""

    def apply_theme(self) -> None:
        """Colours or fonts have changed."""

    def export_arrays(self) -> tuple[ExportArray, ...]:
        """The arrays on the screen, for CSV and FITS; none: only PNG can be saved."""
        return ()
