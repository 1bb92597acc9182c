"""Wave tables, wave generators and trigger outputs of the emulated controller."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_sim.emulators.e727.gcs import (
    GcsCommandError,
    format_array,
    format_lines,
    group_arguments,
    parse_integer,
    parse_number,
)
from escape_sim.emulators.e727.stage import SERVO_S, Hold, Wave
from escape_sim.emulators.e727.state import ControllerState

#: Number of tables, and of points that they share.
TABLES, POINTS = 120, 262_144
#: Largest jump at a start that is accepted, relative to the wave's range.
MAX_START_JUMP = 0.02
#: Trigger lines, parameters of ``CTO``, and its parameter for the mode with the accepted modes.
_LINES, _OUTPUT_PARAMETERS, _MODE, _MODES = (1, 2, 3), (1, 2, 3, 5, 6, 7, 8, 9), 3, (0, 2, 3, 4)


@dataclass
class GeneratorSettings:
    """Settings of the wave generator of one axis."""

    table: int = 0
    cycles: int = 0
    offset: float = 0.0
    rate: int = 1
    interpolate: bool = False
    mode: int = 0


class WaveGenerators:
    """Wave tables, generators and trigger of a controller, and the handlers of their commands.

    Attributes
    ----------
    levels
        Trigger level by line and point of the wave.
    outputs
        Parameters of the trigger lines, set by ``CTO``.
    """

    def __init__(self, state: ControllerState) -> None:
        self._state = state
        self.tables: dict[int, NDArray[np.float64]] = {}
        self.generators = {name: GeneratorSettings() for name in state.axes}
        self.levels: dict[int, dict[int, int]] = {}
        self.outputs: dict[tuple[int, int], float] = {}

    # ------------------------------------------------------------------ tables
    def define(self, args: Sequence[str]) -> None:
        """``WAV table X|&|+ SIN_P|PNT ...``."""
        if len(args) < 4:
            raise GcsCommandError(26)
        table, how, kind = self._table_number(args[0]), args[1].upper(), args[2].upper()
        self._require_unused(table)
        if kind not in ("SIN_P", "PNT"):
            raise GcsCommandError(402)
        segment = _sine(args[3:]) if kind == "SIN_P" else _points(args[3:])
        if how == "X":
            combined = segment
        elif how in ("&", "+") and table not in self.tables:
            raise GcsCommandError(401)
        elif how == "&":
            combined = np.concatenate([self.tables[table], segment])
        elif how == "+" and len(segment) == len(self.tables[table]):
            combined = self.tables[table] + segment
        else:
            raise GcsCommandError(403 if how == "+" else 17)
        others = sum(len(data) for key, data in self.tables.items() if key != table)
        if others + len(combined) > POINTS:
            raise GcsCommandError(67)
        self.tables[table] = combined

    def clear(self, args: Sequence[str]) -> None:
        """``WCL table``."""
        for (text,) in group_arguments(args, 1):
            table = self._table_number(text)
            self._require_unused(table)
            self.tables.pop(table, None)

    def _require_unused(self, table: int) -> None:
        if any(g.table == table and self._state.is_wave_driven(a) for a, g in self.generators.items()):
            raise GcsCommandError(73)

    def lengths(self, args: Sequence[str]) -> str:
        """``WAV? table 1``: number of points of each table."""
        groups = group_arguments(args, 2) if args else []
        if any(parse_integer(parameter) != 1 for _, parameter in groups):
            raise GcsCommandError(17)
        numbers = [self._table_number(table) for table, _ in groups] or sorted(self.tables) or [1]
        return format_lines([f"{t} 1={len(self.tables.get(t, ())):.9e}" for t in numbers])

    def read(self, args: Sequence[str]) -> str:
        """``GWD? first points tables``."""
        if len(args) < 3:
            raise GcsCommandError(26)
        first, count = parse_integer(args[0]), parse_integer(args[1])
        tables = [self._table_number(text) for text in args[2:]]
        if any(table not in self.tables for table in tables):
            raise GcsCommandError(401)
        shortest = min(len(self.tables[table]) for table in tables)
        if first < 1 or count < 1 or first + count - 1 > shortest:
            raise GcsCommandError(17)
        columns = {f"Wave Table {t}": self.tables[t][first - 1 : first - 1 + count] for t in tables}
        return format_array(columns, SERVO_S)

    # ------------------------------------------------------------------ generators
    def select(self, args: Sequence[str]) -> None:
        """``WSL generator table``; 0 selects none."""
        for name, text in group_arguments(args, 2):
            self._require_not_running(name)
            table = parse_integer(text)
            if table and self._table_number(text) not in self.tables:
                raise GcsCommandError(401)
            self.generators[name].table = table

    def set_cycles(self, args: Sequence[str]) -> None:
        """``WGC generator cycles``."""
        for name, text in group_arguments(args, 2):
            self._require_not_running(name)
            if parse_integer(text) < 0:
                raise GcsCommandError(17)
            self.generators[name].cycles = parse_integer(text)

    def set_offset(self, args: Sequence[str]) -> None:
        """``WOS generator offset``."""
        for name, text in group_arguments(args, 2):
            self._require_not_running(name)
            self.generators[name].offset = parse_number(text)

    def set_rate(self, args: Sequence[str]) -> None:
        """``WTR generator rate interpolation``; generator 0 is all."""
        for name, text, interpolation in group_arguments(args, 3):
            rate, interpolate = parse_integer(text), parse_integer(interpolation)
            if not 1 <= rate <= 1_000_000 or interpolate not in (0, 1):
                raise GcsCommandError(17)
            for axis in self.generators if name == "0" else [name]:
                self._require_not_running(axis)
                self.generators[axis].rate, self.generators[axis].interpolate = rate, bool(interpolate)

    def set_modes(self, args: Sequence[str]) -> None:
        """``WGO generator mode``: bit 0 starts, 0 stops; generators of one line start together."""
        state = self._state
        pairs = [(name, parse_integer(text)) for name, text in group_arguments(args, 2)]
        waves = {name: self._prepare_wave(name, mode) for name, mode in pairs if mode}
        state.stage.advance()
        now = state.stage.now
        running = [name for name in state.axes if state.is_wave_driven(name)]
        for name, mode in pairs:
            state.axis(name)
            self.generators[name].mode = mode
            if mode:
                self._check_start(name, waves[name], running)
                generator = self.generators[name]
                state.stage.axes[name].trajectory = Wave(
                    waves[name], now, generator.rate, generator.cycles, generator.interpolate
                )
            elif state.is_wave_driven(name):
                state.stage.axes[name].trajectory = Hold(state.target(name))
        if waves:
            state.recorder.start()

    def _prepare_wave(self, name: str, mode: int) -> NDArray[np.float64]:
        """Targets of a generator that is to start."""
        state = self._state
        state.axis(name)
        if mode not in (1, 0x101):
            raise GcsCommandError(406)
        state.require_idle(name)
        generator = self.generators[name]
        if not generator.table:
            raise GcsCommandError(75)
        if generator.table not in self.tables:
            raise GcsCommandError(401)
        if not state.axes[name].servo:
            raise GcsCommandError(5)
        wave = self.tables[generator.table] + generator.offset
        low, high = state.travel(name)
        if wave.min() < low or wave.max() > high:
            raise GcsCommandError(405)
        return wave

    def _check_start(self, name: str, wave: NDArray[np.float64], running: Sequence[str]) -> None:
        jump = abs(wave[0] - self._state.position(name))
        if jump > MAX_START_JUMP * max(np.ptp(wave), 1.0):
            self._state.report_violation(f"WGO {name} starts with a jump of {jump:.1f} urad; MOV there first")
        if running:
            self._state.report_violation(
                f"WGO {name} starts while {' and '.join(running)} runs: their phase is undefined"
            )

    def queries(self) -> dict[str, Callable[[Sequence[str]], str]]:
        """Handlers of the queries that return settings per generator."""
        generators = self.generators
        values: dict[str, Callable[[str], float | int | str]] = {
            "WSL?": lambda name: generators[name].table,
            "WGC?": lambda name: generators[name].cycles,
            "WOS?": lambda name: generators[name].offset,
            "WTR?": lambda name: f"{generators[name].rate} {int(generators[name].interpolate)}",
            "WGO?": self._mode_text,
        }
        return {command: self._state.per_axis(value) for command, value in values.items()}

    def _mode_text(self, name: str) -> str:
        if not self._state.is_wave_driven(name):
            self.generators[name].mode = 0
        return f"0x{self.generators[name].mode:x}"

    def running(self) -> int:
        """``#9``: one bit for each generator that runs."""
        return sum(self._state.is_wave_driven(name) << bit for bit, name in enumerate(self._state.axes))

    # ------------------------------------------------------------------ trigger
    def clear_trigger(self, args: Sequence[str]) -> None:
        """``TWC``."""
        if args:
            raise GcsCommandError(24)
        self.levels.clear()

    def set_trigger(self, args: Sequence[str]) -> None:
        """``TWS line point level``."""
        for text, point, level in group_arguments(args, 3):
            line, number, value = parse_integer(text), parse_integer(point), parse_integer(level)
            if line not in _LINES or number < 1 or value not in (0, 1):
                raise GcsCommandError(17)
            self.levels.setdefault(line, {})[number] = value

    def set_output(self, args: Sequence[str]) -> None:
        """``CTO line parameter value``; parameter 3 is the mode, whose value 4 is the generator's trigger."""
        for text, parameter, value in group_arguments(args, 3):
            line, number = parse_integer(text), parse_integer(parameter)
            if line not in _LINES or number not in _OUTPUT_PARAMETERS:
                raise GcsCommandError(17)
            if number == _MODE and parse_integer(value) not in _MODES:
                raise GcsCommandError(17)
            self.outputs[line, number] = parse_number(value)

    def output(self, args: Sequence[str]) -> str:
        """``CTO?``."""
        groups = group_arguments(args, 2) if args else []
        pairs = [(parse_integer(a), parse_integer(b)) for a, b in groups] or sorted(self.outputs)
        if any(pair not in self.outputs for pair in pairs) or not pairs:
            raise GcsCommandError(17)
        return format_lines(
            [f"{line} {parameter}={self.outputs[line, parameter]:g}" for line, parameter in pairs]
        )

    # ------------------------------------------------------------------ arguments
    def _require_not_running(self, name: str) -> None:
        self._state.axis(name)
        if self._state.is_wave_driven(name):
            raise GcsCommandError(73)

    def _table_number(self, text: str) -> int:
        if not 1 <= parse_integer(text) <= TABLES:
            raise GcsCommandError(400)
        return parse_integer(text)


def _sine(args: Sequence[str]) -> NDArray[np.float64]:
    """``n A O L S C``: from offset to offset plus amplitude at the centre and back, starting at ``S``."""
    if len(args) != 6:
        raise GcsCommandError(404)
    segment, length, start, centre = (parse_integer(args[k]) for k in (0, 3, 4, 5))
    amplitude, offset = parse_number(args[1]), parse_number(args[2])
    if segment < 1 or length < 2 or length > segment:
        raise GcsCommandError(403)
    if not 0 <= start < segment or not 0 < centre < length:
        raise GcsCommandError(405)
    along = (np.arange(segment) - start) % segment
    rising = np.where(along < centre, along / (2 * centre), 0.5 + (along - centre) / (2 * (length - centre)))
    curve = offset + amplitude / 2 * (1 - np.cos(2 * np.pi * np.minimum(rising, 1.0)))
    return np.asarray(curve, np.float64)


def _points(args: Sequence[str]) -> NDArray[np.float64]:
    """``1 n v1 ... vn``."""
    first, count = parse_integer(args[0]), parse_integer(args[1]) if len(args) > 1 else 0
    if first != 1:
        raise GcsCommandError(405)
    if count < 1 or len(args) - 2 != count:
        raise GcsCommandError(404)
    return np.array([parse_number(text) for text in args[2:]])
