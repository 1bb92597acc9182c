"""The controller's data recorder: positions and targets of the axes, on the servo's clock."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from escape_sim.emulators.e727_stage import SERVO_S, Stage
from escape_sim.emulators.gcs_syntax import Refusal, array, grouped, items, lines, whole

#: Tables, and the points that they share.
TABLES, POINTS = 8, 262_144
#: What can be recorded: nothing, target, position.
NOTHING, TARGET, POSITION = 0, 1, 2
_NAMES = {TARGET: "Target Position of axis", POSITION: "Current Position of axis"}


class Recorder:
    """Fills its tables from a start on.

    Parameters
    ----------
    stage
        Whose axes are recorded.
    """

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.sources = {table: ("0", NOTHING) for table in range(1, TABLES + 1)}
        self.rate = 1
        self._kept: dict[int, list[NDArray[np.float64]]] = {}
        self._begun = -1
        self._next = 0

    @property
    def room(self) -> int:
        """Points of each table."""
        return POINTS // TABLES

    @property
    def running(self) -> bool:
        """True between a start and full tables."""
        return self._begun >= 0 and self._length() < self.room

    def start(self) -> None:
        """Begin anew, now."""
        self._stage.advance()
        if self.running:
            self._stage.unwatch(self._take)
        self._kept = {table: [] for table, (_, option) in self.sources.items() if option != NOTHING}
        if not self._kept:
            return
        self._begun = self._next = self._stage.now
        self._stage.watch(self._take)

    def _length(self) -> int:
        return min((sum(map(len, kept)) for kept in self._kept.values()), default=0)

    def _take(self, first: int, tracks: dict[str, NDArray[np.float64]]) -> None:
        count = len(next(iter(tracks.values())))
        steps = np.arange(max(self._next, first), first + count)
        steps = steps[(steps - self._begun) % self.rate == 0][: self.room - self._length()]
        for table, kept in self._kept.items():
            axis, option = self.sources[table]
            track = (
                tracks[axis][steps - first] if option == POSITION else self._stage.axes[axis].source.at(steps)
            )
            kept.append(np.asarray(track))
        self._next = first + count
        if not self.running:
            self._stage.unwatch(self._take)

    # ------------------------------------------------------------------ commands
    def configure(self, args: Sequence[str]) -> None:
        """``DRC table source option``."""
        for text, axis, option in grouped(args, 3):
            table = self._table(text)
            if whole(option) not in (NOTHING, TARGET, POSITION):
                raise Refusal(59)
            if whole(option) != NOTHING and axis not in self._stage.axes:
                raise Refusal(58)
            self.sources[table] = (axis, whole(option))

    def configuration(self, args: Sequence[str]) -> str:
        """``DRC?``."""
        tables = [self._table(text) for text in args] or list(self.sources)
        return lines([f"{table}={self.sources[table][0]} {self.sources[table][1]}" for table in tables])

    def set_rate(self, args: Sequence[str]) -> None:
        """``RTR``: servo steps for each point."""
        ((text,),) = grouped(args, 1)[:1]
        if len(args) != 1:
            raise Refusal(24)
        if not 1 <= whole(text) <= 1_000_000:
            raise Refusal(17)
        self.rate = whole(text)

    def set_trigger(self, args: Sequence[str]) -> None:
        """``DRT table source value``: here for all tables (0) and the usual commands (0) only."""
        for text, option, _value in grouped(args, 3):
            if whole(text) or whole(option):
                raise Refusal(59)

    def lengths(self, args: Sequence[str]) -> str:
        """``DRL?``: points recorded."""
        self._stage.advance()
        tables = [self._table(text) for text in args] or list(self.sources)
        return items({str(table): sum(map(len, self._kept.get(table, []))) for table in tables})

    def read(self, args: Sequence[str]) -> str:
        """``DRR? offset points tables``."""
        self._stage.advance()
        first = whole(args[0]) if args else 1
        count = whole(args[1]) if len(args) > 1 else self._length() - first + 1
        tables = [self._table(text) for text in args[2:]] or sorted(self._kept)
        if first < 1 or count < 1 or not tables or any(table not in self._kept for table in tables):
            raise Refusal(17)
        if first + count - 1 > self._length():
            raise Refusal(17)
        columns = {}
        for table in tables:
            axis, option = self.sources[table]
            data = np.concatenate(self._kept[table])
            columns[f"{_NAMES[option]}{axis} (table {table})"] = data[first - 1 : first - 1 + count]
        return array(columns, SERVO_S * self.rate)

    def _table(self, text: str) -> int:
        if whole(text) not in self.sources:
            raise Refusal(57)
        return whole(text)
