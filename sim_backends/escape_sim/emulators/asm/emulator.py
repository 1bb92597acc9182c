"""``escape emulate asm``: an adaptive secondary mirror that answers on ESCAPE's own TCP link."""

from __future__ import annotations

import asyncio
import threading
from typing import TYPE_CHECKING, Any

import numpy as np

from escape_hw.api.emulator import Emulator, EmulatorRequest
from escape_hw.errors import ConfigError
from escape_sim.devices.twins import shared_bench
from escape_sim.emulators.asm.controller import AsmController, AsmLimits
from escape_sim.emulators.asm.server import AsmFault, AsmServer, parse_fault_script
from escape_sim.mirror.shell import MovingActuators, RealTimeActuators, Shell

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

#: Port unless told otherwise; the driver's default is the same.
PORT = 7336
#: Watchdog: the shape is held after so many seconds without news, the shell rested after so many.
HOLD_S, REST_S = 0.3, 1.0
#: On the twin, whose time is not real, the computer may be busy for longer.
TWIN_HOLD_S, TWIN_REST_S = 5.0, 20.0
_OPTIONS = ("system", "dust", "fault", "speed", "hold", "rest", "versions")


def make_emulator(request: EmulatorRequest) -> AsmEmulator:
    """Entry point ``asm`` of ``escape.emulators``.

    Raises
    ------
    ConfigError
        An option is unknown or makes no sense.
    """
    options = dict(request.options)
    unknown = [key for key in options if key not in _OPTIONS]
    if unknown:
        raise ConfigError(f"--option {unknown[0]}: unknown; the emulator 'asm' has {', '.join(_OPTIONS)}")
    if request.pty:
        raise ConfigError("--pty: an adaptive secondary is on the network; leave it out")
    return AsmEmulator(request)


class AsmEmulator(Emulator):
    """The mirror of a system behind a TCP port, in a thread of its own.

    Options: ``system`` (whose mirror; ``maps-nir``), ``dust`` (further contaminated actuators,
    ``17,18``), ``fault`` (see :func:`escape_sim.emulators.asm.server.parse_fault_script`), ``speed`` (of the steps
    between states), ``hold`` and ``rest`` (watchdog, seconds), ``versions`` (``1,1``: lowest and
    highest that it speaks).
    """

    def __init__(self, request: EmulatorRequest) -> None:
        options = dict(request.options)
        config = request.config or _load_system(options.get("system", "maps-nir"))
        on_twin = request.shared is not None
        hold, rest = (TWIN_HOLD_S, TWIN_REST_S) if on_twin else (HOLD_S, REST_S)
        dm = config.devices.dm
        actuators: MovingActuators
        bench = shared_bench(config, request.shared) if request.shared is not None else None
        actuators = bench or RealTimeActuators(dm.n_act, config.twin.mirror.settling_s)
        noise = np.random.default_rng(np.random.SeedSequence(config.system.seed, spawn_key=(0xA5,)))
        limits = dm.limits
        slew = limits.max_slew if limits.max_slew is not None else 2.0
        self.controller = AsmController(
            Shell(actuators, dm.n_act, dm.stroke_m, noise),
            AsmLimits(
                limits.max_stroke * dm.stroke_m, slew * dm.stroke_m,
                _positive_option(options, "hold", hold), _positive_option(options, "rest", rest),
            ),
            {*limits.disabled, *_actuator_option(options.get("dust", ""), dm.n_act)},
            speed=_positive_option(options, "speed", 1.0),
            pass_time=None if bench is None else lambda s: bench.advance_to(bench.now_s + s),
        )  # fmt: skip
        low, high = (int(_positive_option({"versions": v}, "versions", 1)) for v in _version_option(options))
        self.server = AsmServer(
            self.controller, dm.serial, parse_fault_script(options.get("fault", "")), (low, high)
        )
        self._host, self._port = request.host, PORT if request.port is None else request.port
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._address = ""

    def start(self) -> str:
        """Begin to listen; returns ``tcp HOST:PORT``.

        Raises
        ------
        ConfigError
            The address cannot be listened on.
        """
        if self._thread is not None:
            return self._address
        loop = asyncio.new_event_loop()
        try:
            port = loop.run_until_complete(self.server.listen(self._host, self._port))
        except OSError as error:
            loop.close()
            raise ConfigError(f"cannot listen on {self._host}:{self._port} ({error})") from error
        self._loop, self._address = loop, f"tcp {self._host}:{port}"
        self._thread = threading.Thread(target=loop.run_forever, name="asm emulator", daemon=True)
        self._thread.start()
        return self._address

    def stop(self) -> None:
        """Hang up and stop listening; may be repeated."""
        if self._thread is None or self._loop is None:
            return
        asyncio.run_coroutine_threadsafe(self.server.shut_down(), self._loop).result()
        self._loop.call_soon_threadsafe(self._loop.stop)
        self._thread.join()
        self._loop.close()
        self._thread = self._loop = None

    def inject(self, text: str) -> None:
        """Have a fault of the mirror happen now, such as ``dust:17``.

        Raises
        ------
        ConfigError
            No such fault.
        """
        fault = AsmFault.from_text(text)
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self.server.apply_mirror_fault, fault)

    @property
    def complaints(self) -> tuple[str, ...]:
        """What clients did that a careful driver would not, in order."""
        return tuple(self.server.complaints)

    def report(self) -> dict[str, Any]:
        """Counters and the mirror's present state."""
        controller, server = self.controller, self.server
        return {
            "state": str(controller.shell.state),
            "fault": controller.shell.fault,
            "note": controller.note,
            "applied": controller.applied,
            "skipped": controller.skipped,
            "requests": len(server.calls),
            "damaged_frames": server.damaged,
        }


def _load_system(name: str) -> SystemConfig:
    from escape_hw.config.loader import load_system

    return load_system(name)


def _positive_option(options: dict[str, str], key: str, default: float) -> float:
    text = options.get(key)
    try:
        value = default if text is None else float(text)
    except ValueError as error:
        raise ConfigError(f"--option {key}={text}: not a number") from error
    if not 0 < value <= 1e6:
        raise ConfigError(f"--option {key}={text}: must be positive")
    return value


def _version_option(options: dict[str, str]) -> tuple[str, str]:
    low, comma, high = options.get("versions", "1,1").partition(",")
    if not comma:
        raise ConfigError(f"--option versions={low}: write LOWEST,HIGHEST")
    return low, high


def _actuator_option(text: str, n_act: int) -> set[int]:
    numbers = [part.strip() for part in text.split(",") if part.strip()]
    if not all(part.isdigit() and int(part) < n_act for part in numbers):
        raise ConfigError(f"--option dust={text}: write numbers of actuators, 0 to {n_act - 1}")
    return {int(part) for part in numbers}
