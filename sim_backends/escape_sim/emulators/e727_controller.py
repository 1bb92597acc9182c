"""The emulated PI E-727: bytes in, a reply for each command out. Knows nothing of sockets."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_sim.emulators.e727_motion import Motion
from escape_sim.emulators.e727_stage import MEMORY, SERVO_S, Source, Wave
from escape_sim.emulators.e727_state import Make, State
from escape_sim.emulators.e727_waves import Waves
from escape_sim.emulators.gcs_syntax import (
    MAX_ARGUMENTS,
    ONE_BYTE,
    Framer,
    Refusal,
    items,
    lines,
    number,
    value_text,
    whole,
)

IDENTITY = "(c)2015-2018 Physik Instrumente (PI) GmbH & Co. KG, E-727.3SDA, {serial}, 14.11.01.05 emulated"
Handler = Callable[[Sequence[str]], str | None]
#: Points of a turn that optics are told.
_SAMPLES = 256


class Controller:
    """A controller with a tip-tilt stage on its first two channels and nothing on the third.

    Parameters
    ----------
    make
        Which controller and stage to be.
    clock
        Seconds, monotonic.
    """

    def __init__(self, make: Make | None = None, clock: Callable[[], float] = time.monotonic) -> None:
        self.make = make or Make()
        self.state = State(self.make, clock)
        self.lock = threading.RLock()
        #: Every command as it was understood, in order.
        self.seen: list[str] = []
        self._framer = Framer()
        self._unasked = ""
        self._turned: tuple[int, list[Source], tuple[float, NDArray[np.float64]] | None] | None = None
        self._connect()

    def _connect(self) -> None:
        """Handlers for the present state."""
        self.waves = Waves(self.state)
        motion, waves, recorder = Motion(self.state), self.waves, self.state.recorder
        self._motion = motion
        self._handlers: dict[str, Handler] = {
            "*IDN?": self._identity, "CSV?": lambda _: "2.0\n", "SAI?": self._axes, "HLP?": self._help,
            "HPA?": self._parameter_list, "VER?": lambda _: "FW_DSP: 14.11.01.05\n", "CST?": self._stages,
            "IFC?": lambda _: "RSBAUD=115200\n",
            "CCL": self._set_level, "CCL?": lambda _: f"{self.state.level}\n",
            "SPA": self._set_parameter, "SPA?": self._parameters, "WPA": self._save, "RBT": self._reboot,
            "SVO": motion.servo, "SVO?": motion.servos, "SVA": motion.volts, "SVA?": motion.told_volts,
            "VOL?": motion.voltages, "ATZ": motion.auto_zero, "ATZ?": motion.is_zeroed, "MOV": motion.move,
            "MVR": motion.move_by, "MOV?": motion.targets, "POS?": motion.places, "ONT?": motion.on_target,
            "VEL": motion.velocity, "VEL?": motion.velocities, "TMN?": motion.lower, "TMX?": motion.upper,
            "PUN?": motion.units, "HLT": motion.halt, "STP": motion.halt,
            "WAV": waves.define, "WAV?": waves.lengths, "GWD?": waves.read, "WCL": waves.clear,
            "WSL": waves.select, "WSL?": waves.selections, "WGC": waves.set_cycles, "WGC?": waves.cycles,
            "WOS": waves.set_offset, "WOS?": waves.offsets, "WTR": waves.set_rate, "WTR?": waves.rates,
            "WGO": waves.go, "WGO?": waves.modes, "WGR": self._record, "STE": self._step_response,
            "IMP": self._step_response, "TWC": waves.clear_trigger, "TWS": waves.set_trigger,
            "CTO": waves.set_output, "CTO?": waves.output, "DRC": recorder.configure,
            "DRC?": recorder.configuration, "DRT": recorder.set_trigger,
            "DRT?": lambda _: "0=0 0\n",
            "RTR": recorder.set_rate, "RTR?": lambda _: f"{recorder.rate}\n",
            "TNR?": lambda _: f"{len(recorder.sources)}\n", "DRL?": recorder.lengths, "DRR?": recorder.read,
        }  # fmt: skip

    # ------------------------------------------------------------------ wire
    def received(self, data: bytes) -> list[str | None]:
        """Take what arrived; returns the commands that it completes, for :meth:`answer`."""
        with self.lock:
            return list(self._framer.feed(data))

    def answer(self, line: str | None) -> bytes:
        """Carry out a command (``None``: a line that was too long); returns its reply, empty if none."""
        with self.lock:
            return self._answer(line)

    def hang_up(self) -> str:
        """The client has gone: an unfinished line is forgotten. Returns how it left the stage."""
        with self.lock:
            self._framer.clear()
            self._check_asked("hung up")
            return self.state.describe()

    def _answer(self, line: str | None) -> bytes:
        if line is None:
            return self._refuse("a line without end", Refusal(3))
        shown = ONE_BYTE.get(line, line)
        self.seen.append(shown)
        try:
            return self._dispatch(line)
        except Refusal as refusal:
            return self._refuse(shown, refusal)

    def _refuse(self, line: str, refusal: Refusal) -> bytes:
        """Remember the error. A careful driver foresees every refusal; a stop is none."""
        self.state.error = refusal.number
        if refusal.number != 10:
            self.state.complain(f"{line}: {refusal}")
        self._unasked = "" if line.partition(" ")[0].endswith("?") else line
        return b""

    def _dispatch(self, line: str) -> bytes:
        if line in ONE_BYTE:
            return self._byte(ONE_BYTE[line])
        words = line.split()
        name, args = words[0].upper(), words[1:]
        if name == "ERR?":
            self._unasked = ""
            error, self.state.error = self.state.error, 0
            return f"{error}\n".encode()
        if not name.endswith("?"):
            self._check_asked(line)
            self._unasked = line
        if len(args) > MAX_ARGUMENTS:
            raise Refusal(24)
        if name not in self._handlers:
            raise Refusal(2)
        reply = self._handlers[name](args)
        return b"" if reply is None else reply.encode("cp1252")

    def _check_asked(self, now: str) -> None:
        """Complain when the last set command's error was never asked for."""
        if self._unasked:
            self.state.complain(f"no ERR? after '{self._unasked}' (then: '{now}')")
            self._unasked = ""

    def _byte(self, line: str) -> bytes:
        """Commands of a single byte, as people write them."""
        if line == "#24":
            self._motion.halt([])
        busy = any(self.state.zeroing(name) for name in self.state.axes)
        reply = {"#5": f"{self._motion.moving():x}", "#8": "0", "#9": f"{self.waves.running():x}"}
        if line == "#7":
            return bytes([0xB0 if busy else 0xB1, 0x0A])
        return f"{reply[line]}\n".encode()

    # ------------------------------------------------------------------ housekeeping
    def _identity(self, args: Sequence[str]) -> str:
        return IDENTITY.format(serial=self.make.serial) + "\n"

    def _axes(self, args: Sequence[str]) -> str:
        return lines(["1", "2", "3"])

    def _help(self, args: Sequence[str]) -> str:
        return lines(
            ["The following commands are valid:", *sorted([*self._handlers, "ERR?", "#5", "#7", "#9", "#24"])]
        )

    def _parameter_list(self, args: Sequence[str]) -> str:
        return lines(
            [f"0x{key:X}= 0 1 FLOAT parameter" for key in sorted({key for _, key in self.state.parameters})]
        )

    def _stages(self, args: Sequence[str]) -> str:
        names = {"1": "S-330.2SL", "2": "S-330.2SL", "3": "NOSTAGE"}
        if any(name not in names for name in args):
            raise Refusal(15)
        return items({name: names[name] for name in args or names})

    def _set_level(self, args: Sequence[str]) -> None:
        if not args:
            raise Refusal(26)
        level = whole(args[0])
        if level not in (0, 1):
            raise Refusal(17)
        if level == 1 and args[1:] != ["advanced"]:
            raise Refusal(56)
        self.state.level = level

    def _set_parameter(self, args: Sequence[str]) -> None:
        if len(args) < 3:
            raise Refusal(26)
        if self.state.level < 1:
            raise Refusal(60)
        item, parameter, value = args[0], whole(args[1]), number(args[2])
        if (item, parameter) not in self.state.parameters:
            raise Refusal(54)
        if parameter >= 0x0E000000:
            raise Refusal(64)
        self.state.parameters[item, parameter] = value

    def _parameters(self, args: Sequence[str]) -> str:
        keys = [(args[k], whole(args[k + 1])) for k in range(0, len(args) - 1, 2)] or list(
            self.state.parameters
        )
        if any(key not in self.state.parameters for key in keys):
            raise Refusal(54)
        # The identifier comes back without its leading zeros.
        return lines(
            [f"{item} 0x{key:X}={value_text(self.state.parameters[item, key])}" for item, key in keys]
        )

    def _save(self, args: Sequence[str]) -> None:
        if list(args) != ["100"]:
            raise Refusal(56)

    def _record(self, args: Sequence[str]) -> None:
        self.state.recorder.start()

    def _step_response(self, args: Sequence[str]) -> None:
        """``STE`` and ``IMP``: recorded moves; the stage here makes the step only."""
        self.state.recorder.start()
        self._motion.move_by(args)

    def _reboot(self, args: Sequence[str]) -> None:
        self.reset()

    def reset(self, *, power_cut: bool = False) -> None:
        """Start anew; a power cut forgets auto-zero as well."""
        with self.lock:
            zeroed = not power_cut and all(axis.zeroed for axis in self.state.axes.values())
            self.state.power_up(zeroed=zeroed)
            self._framer.clear()
            self._unasked = ""
            self._connect()

    # ------------------------------------------------------------------ optics
    def turn(self) -> tuple[float, NDArray[np.float64]] | None:
        """One turn of the stage once it has settled: duration in seconds, true places ``(_SAMPLES, 2)``.

        In microradians; ``None`` while not both axes are driven by waves of one period. The same object
        as long as nothing changes.
        """
        with self.lock:
            sources = [axis.source for axis in self.state.stage.axes.values()]
            running = self.waves.running()
            if self._turned is None or self._turned[0] != running or self._turned[1] != sources:
                self._turned = (running, sources, self._steady_turn())
            return self._turned[2]

    def _steady_turn(self) -> tuple[float, NDArray[np.float64]] | None:
        lengths, tracks = set(), []
        for name, axis in self.state.stage.axes.items():
            source = axis.source
            if not isinstance(source, Wave) or not self.state.moved_by_wave(name):
                return None
            steps = len(source.table) * source.rate
            track = axis.steady(source.start + (MEMORY // steps + 1) * steps, steps)
            at = np.arange(_SAMPLES) * steps / _SAMPLES
            lengths.add(steps)
            tracks.append(np.interp(at, np.arange(steps + 1), [*track, track[0]]))
        if len(lengths) != 1:
            return None
        return lengths.pop() * SERVO_S, np.stack(tracks, axis=1)

    def report(self) -> dict[str, Any]:
        """Counters and condition."""
        with self.lock:
            return {
                "commands": len(self.seen),
                "condition": self.state.describe(),
                "servo": {name: axis.servo for name, axis in self.state.axes.items()},
                "position_urad": {name: self.state.position(name) for name in self.state.axes},
            }
