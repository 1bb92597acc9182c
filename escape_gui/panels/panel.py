"""What all panels have in common."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, ClassVar

from numpy.typing import NDArray
from PySide6.QtCore import Qt
from PySide6.QtWidgets import QLabel, QStackedLayout, QVBoxLayout, QWidget

from escape_gui.session import Session
from escape_gui.theme import Theme
from escape_hw.remote.source import Sample, Source
from escape_hw.remote.state import Health, Phase, State


@dataclass(frozen=True, slots=True, eq=False)
class Context:
    """What a panel works with beside its data.

    Parameters
    ----------
    theme
        Colours and fonts.
    session
        Requests go through ``session.commands``, which is ``None`` in replay.
    """

    theme: Theme
    session: Session


class _Pages(QStackedLayout):
    """Content, or the words that stand for it.

    Where a line wraps, a scroll area would give all that it would like and scroll, though it could do
    with less.
    """

    def hasHeightForWidth(self) -> bool:
        """The least height counts."""
        return False


@dataclass(frozen=True, slots=True, eq=False)
class Shown:
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
    """One dock's content. The window's timer calls :meth:`pull`, only while the panel can be seen.

    A subclass sets the class attributes, puts its widgets into :attr:`body` and overrides
    :meth:`take_state`, :meth:`take_sample`, :meth:`clear` and :meth:`shown`.

    Parameters
    ----------
    context
        Theme and session.
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
    empty: ClassVar[str] = ""
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
        self._stack = _Pages(self)
        holder = QWidget()
        holder.setLayout(self.body)
        self._nothing = QLabel(self.empty)
        self._nothing.setObjectName("empty")
        self._nothing.setWordWrap(True)
        self._nothing.setAlignment(Qt.AlignmentFlag.AlignCenter)
        self._nothing.setContentsMargins(24, 8, 24, 8)
        self._stack.addWidget(holder)
        self._stack.addWidget(self._nothing)
        self._seen: dict[str, int] = {}
        self._serial = self._engine = -1
        self._newest = 0.0
        self.health = Health.STALE
        self.set_empty(bool(self.empty))
        context.theme.changed.connect(self.restyle)
        context.session.changed.connect(self.reset)

    # ------------------------------------------------------------ called by the window
    def pull(self, source: Source) -> None:
        """Take what is new; costs next to nothing when nothing is."""
        state = source.state
        if state.engine_pid != self._engine:
            self.reset()
            self._engine = state.engine_pid
        if state.serial != self._serial:
            self._serial = state.serial
            self.take_state(state)
        for stream in self.streams:
            sample = source.latest(stream, self._seen.get(stream, -1))
            if sample is not None:
                self._seen[stream] = sample.index
                self._newest = time.monotonic()
                self.set_empty(False)
                self.take_sample(stream, sample)
        self.tick(source)
        self.health = self._judge(source, state)

    def _judge(self, source: Source, state: State) -> Health:
        if not source.connected:
            return Health.LOST
        if state.phase is Phase.FAULT:
            return Health.FAULT
        limit = self.stale_after_s
        live = self.context.session.live
        if live and limit is not None and time.monotonic() - self._newest > limit:
            return Health.STALE
        return Health.OK

    def reset(self) -> None:
        """Forget what was seen: another engine counts from the beginning."""
        self._seen.clear()
        self._serial = self._engine = -1
        self._newest = 0.0
        self.clear()
        self.set_empty(bool(self.empty))

    def set_empty(self, empty: bool, why: str | None = None) -> None:
        """Show the note of what to do next (``why`` instead of :attr:`empty`), or the content."""
        if why is not None:
            self._nothing.setText(why)
        elif empty:
            self._nothing.setText(self.empty)
        self._stack.setCurrentIndex(1 if empty else 0)

    @property
    def is_empty(self) -> bool:
        """Whether the note is shown instead of the content."""
        return self._stack.currentIndex() == 1

    # ------------------------------------------------------------ for subclasses
    def take_state(self, state: State) -> None:
        """The state has changed."""

    def take_sample(self, stream: str, sample: Sample) -> None:
        """A stream has a new entry."""

    def tick(self, source: Source) -> None:
        """Once per pull, after state and samples: for what is neither, such as the log."""

    def clear(self) -> None:
        """Drop what belongs to the old source."""

    def restyle(self) -> None:
        """Colours or fonts have changed."""

    def shown(self) -> tuple[Shown, ...]:
        """The arrays on the screen, for CSV and FITS; none: only PNG can be saved."""
        return ()
