"""The emulated PI E-727: executes GCS commands and returns their replies; no sockets."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_sim.emulators.e727.gcs import (
    MAX_ARGUMENTS,
    ONE_BYTE,
    CommandFramer,
    GcsCommandError,
    format_items,
    format_lines,
    parse_integer,
    parse_number,
    value_text,
)
from escape_sim.emulators.e727.motion import MotionCommands
from escape_sim.emulators.e727.stage import SERVO_S, TRANSIENT_STEPS, Trajectory, Wave
from escape_sim.emulators.e727.state import ControllerSettings, ControllerState
from escape_sim.emulators.e727.wave_generator import WaveGenerators

IDENTITY = "(c)2015-2018 Physik Instrumente (PI) GmbH & Co. KG, E-727.3SDA, {serial}, 14.11.01.05 emulated"
Handler = Callable[[Sequence[str]], str | None]
#: Points of a modulation cycle for the optics.
_SAMPLES = 256
#: Newest commands that are kept.
MAX_COMMANDS = 20_000
#: Cycle with its cause: generators running, and trajectories of the axes.
_CycleCache = tuple[int, list[Trajectory], tuple[float, NDArray[np.float64]] | None]


class E727Controller:
    """A controller with a tip-tilt stage on its first two channels and nothing on the third.

    ``clock`` gives monotonic seconds.
    """

    def __init__(
        self, settings: ControllerSettings | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self.settings = settings or ControllerSettings()
        self.state = ControllerState(self.settings, clock)
        self.lock = threading.RLock()
        self._commands: deque[str] = deque(maxlen=MAX_COMMANDS)
        self._n_commands = 0
        self._framer = CommandFramer()
        self._unread_command = ""
        self._cycle_cache: _CycleCache | None = None
        self._build_handlers()

    @property
    def received_commands(self) -> tuple[str, ...]:
        """The newest commands in order."""
        return tuple(self._commands)

    def _build_handlers(self) -> None:
        """Create the handlers for the present state."""
        self.waves = waves = WaveGenerators(self.state)
        self._motion = motion = MotionCommands(self.state)
        recorder = self.state.recorder
        self._handlers: dict[str, Handler] = {
            **motion.queries(), **waves.queries(),
            "*IDN?": lambda _: IDENTITY.format(serial=self.settings.serial) + "\n",
            "CSV?": lambda _: "2.0\n", "SAI?": self._axis_names,
            "HLP?": self._help, "HPA?": self._parameter_list, "VER?": lambda _: "FW_DSP: 14.11.01.05\n",
            "CST?": self._stages, "IFC?": lambda _: "RSBAUD=115200\n",
            "CCL": self._set_level, "CCL?": lambda _: f"{self.state.level}\n",
            "SPA": self._set_parameter, "SPA?": self._parameters, "WPA": self._save,
            "RBT": lambda _: self.reset(),
            "SVO": motion.set_servo, "SVA": motion.set_volts, "ATZ": motion.auto_zero, "MOV": motion.move,
            "MVR": motion.move_by, "VEL": motion.set_velocity, "HLT": motion.halt, "STP": motion.halt,
            "WAV": waves.define, "WAV?": waves.lengths, "GWD?": waves.read, "WCL": waves.clear,
            "WSL": waves.select, "WGC": waves.set_cycles, "WOS": waves.set_offset, "WTR": waves.set_rate,
            "WGO": waves.set_modes, "WGR": lambda _: recorder.start(),
            "STE": self._step_response, "IMP": self._step_response,
            "TWC": waves.clear_trigger, "TWS": waves.set_trigger,
            "CTO": waves.set_output, "CTO?": waves.output, "DRC": recorder.configure,
            "DRC?": recorder.configuration, "DRT": recorder.set_trigger, "DRT?": lambda _: "0=0 0\n",
            "RTR": recorder.set_rate, "RTR?": lambda _: f"{recorder.rate}\n",
            "TNR?": lambda _: f"{len(recorder.sources)}\n", "DRL?": recorder.lengths, "DRR?": recorder.read,
        }  # fmt: skip

    def receive(self, data: bytes) -> list[str | None]:
        """Split received bytes; returns the commands that they complete, for :meth:`execute`."""
        with self.lock:
            return list(self._framer.feed(data))

    def execute(self, line: str | None) -> bytes:
        """Execute a command (None: a line that was too long); returns its reply, empty if it has none."""
        with self.lock:
            return self._execute(line)

    def end_session(self) -> str:
        """The client has disconnected; returns the condition of the stage."""
        with self.lock:
            self._framer.clear()
            self._check_error_was_read("disconnected")
            return self.state.describe()

    def _execute(self, line: str | None) -> bytes:
        if line is None:
            return self._refuse("a line that is too long", GcsCommandError(3))
        readable = ONE_BYTE.get(line, line)
        self._commands.append(readable)
        self._n_commands += 1
        try:
            return self._dispatch(line)
        except GcsCommandError as error:
            return self._refuse(readable, error)

    def _refuse(self, line: str, error: GcsCommandError) -> bytes:
        """Set the error number; a violation unless it is a stop, since a driver can foresee the others."""
        self.state.error = error.number
        if error.number != 10:
            self.state.report_violation(f"{line}: {error}")
        self._unread_command = "" if line.partition(" ")[0].endswith("?") else line
        return b""

    def _dispatch(self, line: str) -> bytes:
        if line in ONE_BYTE:
            return self._handle_single_byte(ONE_BYTE[line])
        words = line.split()
        name, args = words[0].upper(), words[1:]
        if name == "ERR?":
            self._unread_command = ""
            error, self.state.error = self.state.error, 0
            return f"{error}\n".encode()
        if not name.endswith("?"):
            self._check_error_was_read(line)
            self._unread_command = line
        if len(args) > MAX_ARGUMENTS:
            raise GcsCommandError(24)
        if name not in self._handlers:
            raise GcsCommandError(2)
        reply = self._handlers[name](args)
        return b"" if reply is None else reply.encode("cp1252")

    def _check_error_was_read(self, now: str) -> None:
        """Report a violation if the error of the last set command was not queried."""
        if self._unread_command:
            self.state.report_violation(f"no ERR? after '{self._unread_command}' (then: '{now}')")
            self._unread_command = ""

    def _handle_single_byte(self, line: str) -> bytes:
        """Commands of a single byte, in their written form."""
        if line == "#24":
            self._motion.halt([])
        busy = any(self.state.is_zeroing(name) for name in self.state.axes)
        reply = {"#5": f"{self._motion.moving_mask():x}", "#8": "0", "#9": f"{self.waves.running():x}"}
        if line == "#7":
            return bytes([0xB0 if busy else 0xB1, 0x0A])
        return f"{reply[line]}\n".encode()

    def _help(self, args: Sequence[str]) -> str:
        return format_lines(
            ["The following commands are valid:", *sorted([*self._handlers, "ERR?", "#5", "#7", "#9", "#24"])]
        )

    def _parameter_list(self, args: Sequence[str]) -> str:
        return format_lines(
            [f"0x{key:X}= 0 1 FLOAT parameter" for key in sorted({key for _, key in self.state.parameters})]
        )

    def _axis_names(self, args: Sequence[str]) -> str:
        """Names of the axes that answer queries; ``ALL`` adds the one without a stage."""
        if args not in ([], ["ALL"]):
            raise GcsCommandError(56)
        return format_lines([*self.state.axes, *(["3"] if args else [])])

    def _stages(self, args: Sequence[str]) -> str:
        names = {"1": "S-330.2SL", "2": "S-330.2SL", "3": "NOSTAGE"}
        if any(name not in names for name in args):
            raise GcsCommandError(15)
        return format_items({name: names[name] for name in args or names})

    def _set_level(self, args: Sequence[str]) -> None:
        if not args:
            raise GcsCommandError(26)
        level = parse_integer(args[0])
        if level not in (0, 1):
            raise GcsCommandError(17)
        if level == 1 and args[1:] != ["advanced"]:
            raise GcsCommandError(56)
        self.state.level = level

    def _set_parameter(self, args: Sequence[str]) -> None:
        if len(args) < 3:
            raise GcsCommandError(26)
        if self.state.level < 1:
            raise GcsCommandError(60)
        item, parameter, value = args[0], parse_integer(args[1]), parse_number(args[2])
        if (item, parameter) not in self.state.parameters:
            raise GcsCommandError(54)
        if parameter >= 0x0E000000:
            raise GcsCommandError(64)
        self.state.parameters[item, parameter] = value

    def _parameters(self, args: Sequence[str]) -> str:
        keys = [(args[k], parse_integer(args[k + 1])) for k in range(0, len(args) - 1, 2)] or list(
            self.state.parameters
        )
        if any(key not in self.state.parameters for key in keys):
            raise GcsCommandError(54)
        # The parameter's number is returned without leading zeros.
        return format_lines(
            [f"{item} 0x{key:X}={value_text(self.state.parameters[item, key])}" for item, key in keys]
        )

    def _save(self, args: Sequence[str]) -> None:
        if list(args) != ["100"]:
            raise GcsCommandError(56)

    def _step_response(self, args: Sequence[str]) -> None:
        """``STE`` and ``IMP``: recorded moves; only the step is simulated."""
        self.state.recorder.start()
        self._motion.move_by(args)

    def reset(self, *, power_cut: bool = False) -> None:
        """Restart; a power cut also resets auto-zero."""
        with self.lock:
            zeroed = not power_cut and all(axis.zeroed for axis in self.state.axes.values())
            self.state.power_up(zeroed=zeroed)
            self._framer.clear()
            self._unread_command = ""
            self._build_handlers()

    def steady_cycle(self) -> tuple[float, NDArray[np.float64]] | None:
        """Modulation cycle of the settled stage: seconds, and true positions ``(_SAMPLES, 2)`` in urad.

        None unless both axes are driven by waves of one period. The same object until something
        changes.
        """
        with self.lock:
            trajectories = [axis.trajectory for axis in self.state.stage.axes.values()]
            running = self.waves.running()
            cached = self._cycle_cache
            if cached is None or cached[0] != running or cached[1] != trajectories:
                cached = self._cycle_cache = (running, trajectories, self._compute_steady_cycle())
            return cached[2]

    def _compute_steady_cycle(self) -> tuple[float, NDArray[np.float64]] | None:
        lengths, tracks = set(), []
        for name, axis in self.state.stage.axes.items():
            trajectory = axis.trajectory
            if not isinstance(trajectory, Wave) or not self.state.is_wave_driven(name):
                return None
            steps = len(trajectory.table) * trajectory.rate
            track = axis.steady(trajectory.start + (TRANSIENT_STEPS // steps + 1) * steps, steps)
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
                "commands": self._n_commands,
                "condition": self.state.describe(),
                "servo": {name: axis.servo for name, axis in self.state.axes.items()},
                "position_urad": {name: self.state.position(name) for name in self.state.axes},
            }
