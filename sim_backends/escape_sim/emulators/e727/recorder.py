"""Data recorder of the emulated controller: target and measured positions on the servo clock."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from escape_sim.emulators.e727.gcs import (
    GcsCommandError,
    format_array,
    format_items,
    format_lines,
    group_arguments,
    parse_integer,
)
from escape_sim.emulators.e727.stage import SERVO_S, Stage

#: Number of tables, and of points that they share.
TABLES, POINTS = 8, 262_144
#: Recording options: nothing, target, position.
NOTHING, TARGET, POSITION = 0, 1, 2
_NAMES = {TARGET: "Target Position of axis", POSITION: "Current Position of axis"}


class DataRecorder:
    """Records the axes of a stage in tables, from a start until they are full."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.sources = {table: ("0", NOTHING) for table in range(1, TABLES + 1)}
        self.rate = 1
        self._recorded: dict[int, list[NDArray[np.float64]]] = {}
        self._start_step = -1
        self._next_step = 0

    @property
    def running(self) -> bool:
        """Whether it records: started, and tables not full."""
        return self._start_step >= 0 and self._length() < POINTS // TABLES

    def start(self) -> None:
        """Clear the tables and record from now on."""
        self._stage.advance()
        if self.running:
            self._stage.remove_listener(self._record)
        self._recorded = {table: [] for table, (_, option) in self.sources.items() if option != NOTHING}
        if not self._recorded:
            return
        self._start_step = self._next_step = self._stage.now
        self._stage.add_listener(self._record)

    def _length(self) -> int:
        return min((sum(map(len, chunks)) for chunks in self._recorded.values()), default=0)

    def _record(self, first: int, tracks: dict[str, NDArray[np.float64]]) -> None:
        count = len(next(iter(tracks.values())))
        steps = np.arange(max(self._next_step, first), first + count)
        steps = steps[(steps - self._start_step) % self.rate == 0][: POINTS // TABLES - self._length()]
        for table, chunks in self._recorded.items():
            axis, option = self.sources[table]
            track = (
                tracks[axis][steps - first]
                if option == POSITION
                else self._stage.axes[axis].trajectory.at(steps)
            )
            chunks.append(np.asarray(track))
        self._next_step = first + count
        if not self.running:
            self._stage.remove_listener(self._record)

    def configure(self, args: Sequence[str]) -> None:
        """``DRC table trajectory option``."""
        for text, axis, option in group_arguments(args, 3):
            table = self._table(text)
            if parse_integer(option) not in (NOTHING, TARGET, POSITION):
                raise GcsCommandError(59)
            if parse_integer(option) != NOTHING and axis not in self._stage.axes:
                raise GcsCommandError(58)
            self.sources[table] = (axis, parse_integer(option))

    def configuration(self, args: Sequence[str]) -> str:
        """``DRC?``."""
        tables = [self._table(text) for text in args] or list(self.sources)
        return format_lines(
            [f"{table}={self.sources[table][0]} {self.sources[table][1]}" for table in tables]
        )

    def set_rate(self, args: Sequence[str]) -> None:
        """``RTR``: servo steps per point."""
        ((text,),) = group_arguments(args, 1)[:1]
        if len(args) != 1:
            raise GcsCommandError(24)
        if not 1 <= parse_integer(text) <= 1_000_000:
            raise GcsCommandError(17)
        self.rate = parse_integer(text)

    def set_trigger(self, args: Sequence[str]) -> None:
        """``DRT table source value``: only all tables (0) and the default source (0) are supported."""
        for text, option, _value in group_arguments(args, 3):
            if parse_integer(text) or parse_integer(option):
                raise GcsCommandError(59)

    def lengths(self, args: Sequence[str]) -> str:
        """``DRL?``: number of points recorded."""
        self._stage.advance()
        tables = [self._table(text) for text in args] or list(self.sources)
        return format_items({str(table): sum(map(len, self._recorded.get(table, []))) for table in tables})

    def read(self, args: Sequence[str]) -> str:
        """``DRR? offset points tables``."""
        self._stage.advance()
        first = parse_integer(args[0]) if args else 1
        count = parse_integer(args[1]) if len(args) > 1 else self._length() - first + 1
        tables = [self._table(text) for text in args[2:]] or sorted(self._recorded)
        if first < 1 or count < 1 or not tables or any(table not in self._recorded for table in tables):
            raise GcsCommandError(17)
        if first + count - 1 > self._length():
            raise GcsCommandError(17)
        columns = {}
        for table in tables:
            axis, option = self.sources[table]
            data = np.concatenate(self._recorded[table])
            columns[f"{_NAMES[option]}{axis} (table {table})"] = data[first - 1 : first - 1 + count]
        return format_array(columns, SERVO_S * self.rate)

    def _table(self, text: str) -> int:
        if parse_integer(text) not in self.sources:
            raise GcsCommandError(57)
        return parse_integer(text)
