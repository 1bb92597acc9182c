"""What a PI E-727 can do, verb by verb; every reply is checked, every command confirmed."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from itertools import product
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_drivers import pi_gcs
from escape_drivers.pi_circle import Sine, Turn
from escape_drivers.pi_errors import Refused
from escape_drivers.pi_gcs import Garbled
from escape_drivers.pi_link import Link
from escape_hw.errors import DeviceError

V = TypeVar("V")
log = logging.getLogger(__name__)

#: Parameter that holds the servo's period.
_SERVO_PERIOD = 0x0E000200
#: Question of a single byte: which wave generators run.
_RUNNING = 9
#: Error that every stop leaves.
_STOPPED = 10
#: How often a stage on its way is asked whether it has arrived, in seconds.
_POLL_S = 0.01
#: Values of a line of points: the other five arguments are table, how, kind, first and number.
_BUNCH = pi_gcs.MAX_ARGUMENTS - 5
#: Recorder: target and current position of an axis.
_TARGET, _POSITION = 1, 2
#: How well volts, and places in the controller's units, have to read back.
_SAME_VOLTS, _SAME_PLACE = 0.1, 1e-3
#: Tilt units that the controller may report.
_UNITS = {"urad": 1e-6, "µrad": 1e-6, "mrad": 1e-3, "rad": 1.0}


class E727:
    """The controller behind a link.

    Parameters
    ----------
    link
        An open link.
    axes
        The axes in use.
    """

    def __init__(self, link: Link, axes: tuple[str, str]) -> None:
        self.link, self.axes = link, axes
        self._bits: list[int] | None = None

    # ------------------------------------------------------------------ who and what
    @property
    def model(self) -> str:
        """Model, as the controller tells it."""
        return self._identity(1)

    @property
    def serial(self) -> str:
        """Serial number of the controller."""
        return self._identity(2)

    def _identity(self, field: int) -> str:
        # Maker, model, serial number, firmware; the maker's name may hold commas of its own.
        fields = [text.strip() for text in self.link.identity.rsplit(",", 3)]
        return fields[field] if len(fields) == 4 else ""

    def channels(self) -> list[str]:
        """Names of all axes."""

        def parse(reply: list[str]) -> list[str]:
            names = [text.strip() for text in reply]
            if not all(name.isascii() and name.isalnum() for name in names):
                raise Garbled(f"{' / '.join(reply)[:80]!r} where names of axes were due")
            return names

        return self.link.ask(parse, "SAI?")

    def stages(self) -> list[str]:
        """What is connected to the axes in use."""
        return self._each("CST?", pi_gcs.values)

    def unit_rad(self) -> float:
        """Radians per unit of the axes.

        Raises
        ------
        Garbled
            A unit that is no angle.
        """

        def parse(reply: list[str]) -> float:
            units = pi_gcs.values(reply, self.axes)
            if units[0].casefold() not in _UNITS or units[0] != units[1]:
                raise Garbled(f"axes in units of {' and '.join(units)}, not in one angle")
            return _UNITS[units[0].casefold()]

        return self.link.ask(parse, "PUN?", *self.axes)

    def servo_period_s(self) -> float:
        """Period of the servo, on which waves are played."""

        def parse(reply: list[str]) -> float:
            key, _, value = pi_gcs.single(reply).partition("=")
            item, _, number = key.strip().partition(" ")
            period = pi_gcs.real(value)
            if item != "1" or pi_gcs.whole(number.strip(), 0) != _SERVO_PERIOD or not 1e-7 < period < 0.1:
                raise Garbled(f"{reply[0]!r} where the servo's period was due")
            return period

        return self.link.ask(parse, "SPA?", "1", f"0x{_SERVO_PERIOD:08X}")

    def limits(self) -> tuple[list[float], list[float]]:
        """Lower and upper ends of the axes' travel, in the controller's unit."""
        return self._each("TMN?", pi_gcs.reals), self._each("TMX?", pi_gcs.reals)

    # ------------------------------------------------------------------ servo and places
    def set_servo(self, on: bool) -> None:
        """Switch both servos."""
        self._set_each("SVO", [int(on)] * 2)
        self._require("SVO", [float(on)] * 2, [float(is_on) for is_on in self.servos()], 0)

    def servos(self) -> list[bool]:
        """Which servos are on."""
        return [text == "1" for text in self._each("SVO?", pi_gcs.values)]

    def set_volts(self, volts: float) -> None:
        """Drive both axes with the servos off."""
        self._set_each("SVA", [float(volts)] * 2)
        self._require("SVA", [volts] * 2, self._each("SVA?", pi_gcs.reals), _SAME_VOLTS)

    def move(self, places: Sequence[float]) -> None:
        """Targets of both axes."""
        self._set_each("MOV", [float(place) for place in places])
        self._require("MOV", places, self._each("MOV?", pi_gcs.reals), _SAME_PLACE)

    def go(self, places: NDArray[np.float64], longest_s: float, sleep: Callable[[float], None]) -> None:
        """Move both axes and wait until they are there.

        Raises
        ------
        DeviceError
            They are not after ``longest_s`` seconds.
        """
        self.move([float(place) for place in places])
        deadline = time.monotonic() + longest_s
        while not self.on_target():
            if time.monotonic() > deadline:
                here, there = (", ".join(f"{x:.2f}" for x in each) for each in (self.places(), places))
                raise DeviceError(
                    self.link.name,
                    f"has not settled at {there} within {longest_s:g} s, it is at {here} (its units); "
                    "is the platform free to move? The longest wait is devices.modulator.stage.settle_s",
                )
            sleep(_POLL_S)

    def places(self) -> list[float]:
        """Where both axes are."""
        return self._each("POS?", pi_gcs.reals)

    def on_target(self) -> bool:
        """True when both axes are where they should be."""
        return self._each("ONT?", pi_gcs.values) == ["1", "1"]

    def start_auto_zero(self, axis: str, volts: float | None) -> None:
        """Begin to auto-zero an axis; ``None``: at the controller's own voltage."""
        self.link.tell("ATZ", axis, "NaN" if volts is None else float(volts), again=False)

    def zeroed(self) -> list[bool]:
        """Which axes have been auto-zeroed."""
        return [text == "1" for text in self._each("ATZ?", pi_gcs.values)]

    def clear_error(self) -> None:
        """Ask away an error that no command of ours has left, lest the next one be blamed for it."""
        number = self.link.ask(_number, "ERR?")
        if number:
            log.warning("%s", Refused(self.link.name, number, "something before"))

    def check_error(self, cause: str) -> None:
        """Raise the error that a command which takes its time has left behind, if any.

        Raises
        ------
        Refused
            There is one.
        """
        number = self.link.ask(_number, "ERR?")
        if number:
            raise Refused(self.link.name, number, cause)

    def halt(self) -> None:
        """Stop all motion, auto-zero too; the error that this leaves is expected."""
        try:
            self.link.tell("STP")
        except Refused as stopped:
            if stopped.number != _STOPPED:
                raise

    # ------------------------------------------------------------------ waves
    def write_points(self, table: int, points: NDArray[np.float64]) -> None:
        """A wave table point by point, in as many lines as it takes."""
        for first in range(0, len(points), _BUNCH):
            bunch = [float(value) for value in points[first : first + _BUNCH]]
            how = "&" if first else "X"
            # Appending twice would make another wave.
            self.link.tell("WAV", str(table), how, "PNT", 1, len(bunch), *bunch, again=not first)

    def write_sine(self, table: int, turn: Turn, sine: Sine) -> None:
        """A wave table that the controller draws itself."""
        n = turn.points
        self.link.tell(
            "WAV", str(table), "X", "SIN_P", n, float(sine.height), float(sine.offset), n, sine.start, n // 2
        )

    def table(self, table: int, points: int) -> NDArray[np.float64]:
        """What a wave table holds ``(points,)``."""
        return self.link.ask(
            lambda reply: pi_gcs.array(reply, 1, points)[:, 0], "GWD?", 1, points, str(table)
        )

    def set_generators(self, rate: int) -> None:
        """Table k drives axis k, for ever, about the tables' own middle, ``rate`` servo periods a point."""
        first, second = self.axes
        self.link.tell("WSL", first, 1, second, 2)
        self.link.tell("WGC", first, 0, second, 0)
        self.link.tell("WOS", first, 0, second, 0)
        self.link.tell("WTR", first, rate, int(rate > 1), second, rate, int(rate > 1))
        self._require("WSL", [1, 2], self._each("WSL?", pi_gcs.reals), 0)
        self._require("WGC", [0, 0], self._each("WGC?", pi_gcs.reals), 0)
        self._require("WOS", [0, 0], self._each("WOS?", pi_gcs.reals), 0)
        self._require("WTR", [rate, rate], self._rates(), 0)

    def start(self) -> None:
        """Start both axes in the same servo cycle."""
        self.link.tell("WGO", self.axes[0], 1, self.axes[1], 1, again=False)

    def stop(self) -> None:
        """Stop both axes' generators."""
        self.link.tell("WGO", self.axes[0], 0, self.axes[1], 0)
        self._require("WGO", [0, 0], [float(runs) for runs in self.running()], 0)

    def running(self) -> list[bool]:
        """Which of the axes' generators run: a mask over all axes, asked with a single byte."""
        if self._bits is None:
            order = self.channels()
            if not set(self.axes) <= set(order):
                raise Garbled(
                    f"axes {', '.join(order)}, where {' and '.join(self.axes)} have to be among them"
                )
            self._bits = [order.index(axis) for axis in self.axes]
        mask = self.link.ask_byte(_RUNNING)
        return [bool(mask >> bit & 1) for bit in self._bits]

    def played(self) -> tuple[Turn, list[NDArray[np.float64]]]:
        """The waves that the generators play: their turn, and the targets of both axes ``(points,)`` each."""
        tables = [pi_gcs.whole(text) for text in self._each("WSL?", pi_gcs.values)]
        rates = self._rates()
        offsets = self._each("WOS?", pi_gcs.reals)
        points = [self._length(table) for table in tables]
        waves = [self.table(t, n) + o for t, n, o in zip(tables, points, offsets, strict=True)]
        return Turn(points[0], rates[0]), waves

    def _rates(self) -> list[int]:
        # Rate and interpolation.
        return self._each("WTR?", lambda reply, keys: [_first_whole(x) for x in pi_gcs.values(reply, keys)])

    def _length(self, table: int) -> int:
        return self.link.ask(lambda reply: int(pi_gcs.reals(reply, [f"{table} 1"])[0]), "WAV?", str(table), 1)

    # ------------------------------------------------------------------ trigger and recorder
    def set_trigger(self, line: int, mode: int, point: int, points: int) -> None:
        """A pulse on an output once a turn: up at ``point``, down half a turn later."""
        down = (point - 1 + points // 2) % points + 1
        self.link.tell("TWC")
        for at, level in sorted([(point, 1), (down, 0)]):
            self.link.tell("TWS", line, at, level)
        self.link.tell("CTO", line, 3, mode)

    def clear_trigger(self) -> None:
        """No pulses any more."""
        self.link.tell("TWC")

    def record(
        self, points: int, rate: int, wait: Callable[[float], None], servo_s: float
    ) -> NDArray[np.float64]:
        """Positions, then targets of both axes ``(points, 4)``, every ``rate`` servo periods from now on.

        Targets come along because nobody promises at which point of the turn a recording begins.

        Parameters
        ----------
        wait
            Called with the seconds that the recording takes.
        """
        tables = range(1, 5)
        for table, (option, axis) in zip(tables, product((_POSITION, _TARGET), self.axes), strict=True):
            self.link.tell("DRC", table, axis, option)
        self.link.tell("RTR", rate)
        self.link.tell("WGR")
        lasts_s = points * rate * servo_s
        wait(lasts_s)
        for _ in range(3):
            if self._recorded(tables) >= points:
                break
            wait(0.5 * lasts_s + 0.01)
        return self.link.ask(lambda reply: pi_gcs.array(reply, 4, points), "DRR?", 1, points, *tables)

    def _recorded(self, tables: Sequence[int]) -> int:
        """Points recorded so far."""
        names = [str(table) for table in tables]
        return self.link.ask(lambda reply: int(min(pi_gcs.reals(reply, names))), "DRL?", *tables)

    # ------------------------------------------------------------------ both axes
    def _each(self, question: str, parse: Callable[[list[str], Sequence[str]], list[V]]) -> list[V]:
        return self.link.ask(lambda reply: parse(reply, self.axes), question, *self.axes)

    def _require(self, command: str, want: Sequence[float], found: Sequence[float], within: float) -> None:
        """Make sure that a confirmed command has had its effect."""
        if any(abs(a - b) > within for a, b in zip(want, found, strict=True)):
            shown = [", ".join(f"{x:g}" for x in values) for values in (want, found)]
            raise DeviceError(
                self.link.name,
                f"confirmed '{command}' to {shown[0]}, but reads back {shown[1]}; does another "
                "program (or an analogue input) drive the axes? Close it, then open again",
            )

    def _set_each(self, command: str, both: Sequence[int | float]) -> None:
        self.link.tell(command, self.axes[0], both[0], self.axes[1], both[1])


def _number(reply: list[str]) -> int:
    """A reply of one whole number."""
    return pi_gcs.whole(pi_gcs.single(reply))


def _first_whole(text: str) -> int:
    """The first of several whole numbers."""
    return pi_gcs.whole((text.split() or [""])[0])
