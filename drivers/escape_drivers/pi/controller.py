"""What a PI E-727 can do, verb by verb; every reply is checked, every command confirmed."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_drivers.pi import gcs as pi_gcs
from escape_drivers.pi.gcs import GcsError, MalformedReply
from escape_drivers.pi.link import GcsLink
from escape_drivers.pi.wave_table import CycleTiming, SineTable
from escape_hw.errors import DeviceError

V = TypeVar("V")
log = logging.getLogger(__name__)

#: Parameter that holds the servo's period.
_SERVO_PERIOD = 0x0E000200
#: Question of a single byte: which wave generators run.
_QUERY_RUNNING = 9
#: Error that every stop leaves.
_ERROR_STOPPED = 10
#: Interval of on-target queries while the stage moves, in seconds.
_POLL_S = 0.01
#: Values of a line of points: the other five arguments are table, how, kind, first and number.
_POINTS_PER_LINE = pi_gcs.MAX_ARGUMENTS - 5
#: Recorder: target and current position of an axis.
_TARGET, _POSITION = 1, 2
#: How well volts, and places in the controller's units, have to read back.
_VOLTAGE_TOLERANCE, _POSITION_TOLERANCE = 0.1, 1e-3
#: Tilt units that the controller may report.
_UNITS = {"urad": 1e-6, "µrad": 1e-6, "mrad": 1e-3, "rad": 1.0}


class E727:
    """The controller behind an open link, with the names of the axes in use.

    A reply that is not as expected raises :class:`~escape_drivers.pi.gcs.MalformedReply`; a refused command
    raises :class:`~escape_drivers.pi.gcs.GcsError`.
    """

    def __init__(self, link: GcsLink, axes: tuple[str, str]) -> None:
        self.link, self.axes = link, axes
        self._generator_bits: list[int] | None = None

    # ------------------------------------------------------------------ identity
    @property
    def model(self) -> str:
        """Model, as the controller reports it."""
        return self._identity_field(1)

    @property
    def serial(self) -> str:
        """Serial number of the controller."""
        return self._identity_field(2)

    def _identity_field(self, field: int) -> str:
        # Maker, model, serial number, firmware; the maker's name may contain commas.
        fields = [text.strip() for text in self.link.identity.rsplit(",", 3)]
        return fields[field] if len(fields) == 4 else ""

    def axis_names(self) -> list[str]:
        """Names of all axes."""

        def parse(reply: list[str]) -> list[str]:
            names = [text.strip() for text in reply]
            if not all(name.isascii() and name.isalnum() for name in names):
                raise MalformedReply(f"{' / '.join(reply)[:80]!r} where names of axes were due")
            return names

        return self.link.query(parse, "SAI?")

    def stage_names(self) -> list[str]:
        """What is connected to the axes in use."""
        return self._query_axes("CST?", pi_gcs.values)

    def unit_rad(self) -> float:
        """Radians per unit of the axes, which must be an angle."""

        def parse(reply: list[str]) -> float:
            units = pi_gcs.values(reply, self.axes)
            if units[0].casefold() not in _UNITS or units[0] != units[1]:
                raise MalformedReply(f"axes in units of {' and '.join(units)}, not in one angle")
            return _UNITS[units[0].casefold()]

        return self.link.query(parse, "PUN?", *self.axes)

    def servo_period_s(self) -> float:
        """Period of the servo, on which waves are played."""

        def parse(reply: list[str]) -> float:
            key, _, value = pi_gcs.parse_single_line(reply).partition("=")
            item, _, number = key.strip().partition(" ")
            period = pi_gcs.parse_float(value)
            if item != "1" or pi_gcs.parse_int(number.strip(), 0) != _SERVO_PERIOD or not 1e-7 < period < 0.1:
                raise MalformedReply(f"{reply[0]!r} where the servo's period was due")
            return period

        return self.link.query(parse, "SPA?", "1", f"0x{_SERVO_PERIOD:08X}")

    def limits(self) -> tuple[list[float], list[float]]:
        """Lower and upper ends of the axes' travel, in the controller's unit."""
        return self._query_axes("TMN?", pi_gcs.parse_floats), self._query_axes("TMX?", pi_gcs.parse_floats)

    # ------------------------------------------------------------------ servo and places
    def set_servo(self, on: bool) -> None:
        """Switch both servos."""
        self._set_axes("SVO", [int(on)] * 2)
        self._verify_readback("SVO", [float(on)] * 2, [float(is_on) for is_on in self.servo_states()], 0)

    def servo_states(self) -> list[bool]:
        """Which servos are on."""
        return [text == "1" for text in self._query_axes("SVO?", pi_gcs.values)]

    def set_volts(self, volts: float) -> None:
        """Drive both axes with the servos off."""
        self._set_axes("SVA", [float(volts)] * 2)
        self._verify_readback(
            "SVA", [volts] * 2, self._query_axes("SVA?", pi_gcs.parse_floats), _VOLTAGE_TOLERANCE
        )

    def set_targets(self, positions: Sequence[float]) -> None:
        """Targets of both axes."""
        self._set_axes("MOV", [float(place) for place in positions])
        self._verify_readback(
            "MOV", positions, self._query_axes("MOV?", pi_gcs.parse_floats), _POSITION_TOLERANCE
        )

    def move_and_wait(
        self, positions: NDArray[np.float64], longest_s: float, sleep: Callable[[float], None]
    ) -> None:
        """Move both axes to ``positions (2,)`` in its unit and wait; ``DeviceError`` after ``longest_s``."""
        self.set_targets([float(place) for place in positions])
        deadline = time.monotonic() + longest_s
        while not self.on_target():
            if time.monotonic() > deadline:
                here, there = (", ".join(f"{x:.2f}" for x in each) for each in (self.positions(), positions))
                raise DeviceError(
                    self.link.name,
                    f"has not settled at {there} within {longest_s:g} s, it is at {here} (its units); "
                    "is the platform free to move? The longest wait is stage.settle_s",
                )
            sleep(_POLL_S)

    def positions(self) -> list[float]:
        """Where both axes are."""
        return self._query_axes("POS?", pi_gcs.parse_floats)

    def on_target(self) -> bool:
        """True when both axes are where they should be."""
        return self._query_axes("ONT?", pi_gcs.values) == ["1", "1"]

    def start_auto_zero(self, axis: str, volts: float | None) -> None:
        """Begin to auto-zero an axis; ``None``: at the controller's own voltage."""
        self.link.send_command("ATZ", axis, "NaN" if volts is None else float(volts), repeatable=False)

    def auto_zeroed(self) -> list[bool]:
        """Which axes have been auto-zeroed."""
        return [text == "1" for text in self._query_axes("ATZ?", pi_gcs.values)]

    def clear_error(self) -> None:
        """Read and discard an earlier error, so that it is not attributed to the next command."""
        number = self.link.query(pi_gcs.parse_single_int, "ERR?")
        if number:
            log.warning("%s", GcsError(self.link.name, number, "something before"))

    def check_error(self, cause: str) -> None:
        """Raise the error that a command which takes its time has left behind, if any."""
        number = self.link.query(pi_gcs.parse_single_int, "ERR?")
        if number:
            raise GcsError(self.link.name, number, cause)

    def stop_all(self) -> None:
        """Stop all motion including auto-zero; the resulting error is expected."""
        try:
            self.link.send_command("STP")
        except GcsError as stopped:
            if stopped.number != _ERROR_STOPPED:
                raise

    # ------------------------------------------------------------------ waves
    def write_points(self, table: int, points: NDArray[np.float64]) -> None:
        """A wave table point by point ``(n,)``, in the unit of the axis, in as many lines as it takes."""
        for first in range(0, len(points), _POINTS_PER_LINE):
            chunk = [float(value) for value in points[first : first + _POINTS_PER_LINE]]
            how = "&" if first else "X"
            # Appending twice would make another wave.
            self.link.send_command("WAV", str(table), how, "PNT", 1, len(chunk), *chunk, repeatable=not first)

    def write_sine(self, table: int, turn: CycleTiming, sine: SineTable) -> None:
        """A wave table that the controller draws itself."""
        n = turn.points
        self.link.send_command(
            "WAV", str(table), "X", "SIN_P", n, float(sine.height), float(sine.offset), n, sine.start, n // 2
        )

    def table(self, table: int, points: int) -> NDArray[np.float64]:
        """What a wave table holds ``(points,)``."""
        return self.link.query(
            lambda reply: pi_gcs.array(reply, 1, points)[:, 0], "GWD?", 1, points, str(table)
        )

    def set_generators(self, rate: int) -> None:
        """Table k drives axis k, for ever, about the tables' own middle, ``rate`` servo periods a point."""
        first, second = self.axes
        self.link.send_command("WSL", first, 1, second, 2)
        self.link.send_command("WGC", first, 0, second, 0)
        self.link.send_command("WOS", first, 0, second, 0)
        self.link.send_command("WTR", first, rate, int(rate > 1), second, rate, int(rate > 1))
        for command, want in (("WSL", [1, 2]), ("WGC", [0, 0]), ("WOS", [0, 0])):
            self._verify_readback(command, want, self._query_axes(f"{command}?", pi_gcs.parse_floats), 0)
        self._verify_readback("WTR", [rate, rate], self._table_rates(), 0)

    def start(self) -> None:
        """Start both axes in the same servo cycle."""
        self.link.send_command("WGO", self.axes[0], 1, self.axes[1], 1, repeatable=False)

    def stop(self) -> None:
        """Stop both axes' generators."""
        self.link.send_command("WGO", self.axes[0], 0, self.axes[1], 0)
        self._verify_readback("WGO", [0, 0], [float(runs) for runs in self.running()], 0)

    def running(self) -> list[bool]:
        """Running wave generators: a mask over all axes, queried with a single byte."""
        if self._generator_bits is None:
            order = self.axis_names()
            if not set(self.axes) <= set(order):
                raise MalformedReply(
                    f"axes {', '.join(order)}, where {' and '.join(self.axes)} have to be among them"
                )
            self._generator_bits = [order.index(axis) for axis in self.axes]
        mask = self.link.query_byte(_QUERY_RUNNING)
        return [bool(mask >> bit & 1) for bit in self._generator_bits]

    def read_waves(self) -> tuple[CycleTiming, list[NDArray[np.float64]]]:
        """The waves that the generators play: their turn, and the targets of both axes ``(points,)`` each."""
        tables = [pi_gcs.parse_int(text) for text in self._query_axes("WSL?", pi_gcs.values)]
        rates = self._table_rates()
        offsets = self._query_axes("WOS?", pi_gcs.parse_floats)
        points = [self._table_points(table) for table in tables]
        waves = [self.table(t, n) + o for t, n, o in zip(tables, points, offsets, strict=True)]
        return CycleTiming(points[0], rates[0]), waves

    def _table_rates(self) -> list[int]:
        # Rate and interpolation.
        return self._query_axes(
            "WTR?", lambda reply, keys: [_parse_first_int(x) for x in pi_gcs.values(reply, keys)]
        )

    def _table_points(self, table: int) -> int:
        return self.link.query(
            lambda reply: int(pi_gcs.parse_floats(reply, [f"{table} 1"])[0]), "WAV?", str(table), 1
        )

    # ------------------------------------------------------------------ trigger and recorder
    def set_trigger(self, line: int, mode: int, point: int, points: int) -> None:
        """A pulse on an output once a turn: up at ``point``, down half a turn later."""
        down = (point - 1 + points // 2) % points + 1
        self.link.send_command("TWC")
        for at, level in sorted([(point, 1), (down, 0)]):
            self.link.send_command("TWS", line, at, level)
        self.link.send_command("CTO", line, 3, mode)

    def clear_trigger(self) -> None:
        """No pulses any more."""
        self.link.send_command("TWC")

    def record(
        self, points: int, rate: int, wait: Callable[[float], None], servo_s: float
    ) -> NDArray[np.float64]:
        """Positions, then targets of both axes ``(points, 4)``, every ``rate`` servo periods from now on.

        Targets are recorded as well, because a recording may begin at any point of the turn. ``wait`` is
        called with the seconds that the recording takes.
        """
        tables = range(1, 5)
        for table, (option, axis) in zip(tables, product((_POSITION, _TARGET), self.axes), strict=True):
            self.link.send_command("DRC", table, axis, option)
        self.link.send_command("RTR", rate)
        self.link.send_command("WGR")
        lasts_s = points * rate * servo_s
        wait(lasts_s)
        for _ in range(3):
            if self._recorded_points(tables) >= points:
                break
            wait(0.5 * lasts_s + 0.01)
        return self.link.query(lambda reply: pi_gcs.array(reply, 4, points), "DRR?", 1, points, *tables)

    def _recorded_points(self, tables: Sequence[int]) -> int:
        """Points recorded so far."""
        names = [str(table) for table in tables]
        return self.link.query(lambda reply: int(min(pi_gcs.parse_floats(reply, names))), "DRL?", *tables)

    # ------------------------------------------------------------------ both axes
    def _query_axes(self, question: str, parse: Callable[[list[str], Sequence[str]], list[V]]) -> list[V]:
        return self.link.query(lambda reply: parse(reply, self.axes), question, *self.axes)

    def _verify_readback(
        self, command: str, want: Sequence[float], found: Sequence[float], within: float
    ) -> None:
        """Make sure that a confirmed command has had its effect."""
        if any(abs(a - b) > within for a, b in zip(want, found, strict=True)):
            shown = [", ".join(f"{x:g}" for x in values) for values in (want, found)]
            raise DeviceError(
                self.link.name,
                f"confirmed '{command}' to {shown[0]}, but reads back {shown[1]}; does another "
                "program (or an analogue input) drive the axes? Close it, then open again",
            )

    def _set_axes(self, command: str, both: Sequence[int | float]) -> None:
        self.link.send_command(command, self.axes[0], both[0], self.axes[1], both[1])


def _parse_first_int(text: str) -> int:
    """The first of several whole numbers."""
    return pi_gcs.parse_int((text.split() or [""])[0])
