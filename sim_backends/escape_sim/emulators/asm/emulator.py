"""``escape emulate asm``: an adaptive secondary on ESCAPE's TCP link."""

from __future__ import annotations

import asyncio
import contextlib
import sys
import threading
from typing import Annotated, Any, ClassVar

import numpy as np
from pydantic import Field

from escape_hw.api.emulator import Emulator, EmulatorRequest
from escape_hw.config.loader import load_system
from escape_hw.errors import ConfigError
from escape_sim.devices.twins import shared_bench
from escape_sim.emulators.asm.controller import AsmController, AsmLimits
from escape_sim.emulators.asm.server import AsmFault, AsmServer
from escape_sim.emulators.options import EmulatorOptions, parse_fault_script
from escape_sim.mirror.shell import MovingActuators, RealTimeActuators, Shell

#: Default port, as of the driver.
PORT = 7336
#: Watchdog: times in seconds without a frame after which the shape is held and the shell is rested.
HOLD_S, REST_S = 0.3, 1.0
#: The same on a simulated bench, whose computation may take longer than the simulated time.
TWIN_HOLD_S, TWIN_REST_S = 5.0, 20.0
#: Time in seconds for closing the connections.
STOP_S = 10.0
Positive = Annotated[float, Field(gt=0, le=1e6)]


def make_emulator(request: EmulatorRequest) -> AsmEmulator:
    """Entry point ``asm``; raises ``ConfigError`` if an option is unknown or has no valid value."""
    if request.pty:
        raise ConfigError("--pty: an adaptive secondary is on the network; omit it")
    return AsmEmulator(request)


class AsmEmulatorOptions(EmulatorOptions):
    """Options of :class:`AsmEmulator`."""

    RENAMED: ClassVar = {
        "dust": "contaminated", "speed": "transition_speed", "hold": "hold_s", "rest": "rest_s",
    }  # fmt: skip

    system: str = "maps-nir"
    contaminated: str = ""
    fault: str = ""
    transition_speed: Positive = 1.0
    hold_s: Positive | None = None
    rest_s: Positive | None = None
    versions: str = Field("1,1", pattern=r"^\d+,\d+$")


class AsmEmulator(Emulator):
    """The adaptive secondary of a system behind a TCP port, in its own thread.

    Options: ``system`` (default ``maps-nir``), ``contaminated`` (further contaminated actuators,
    ``17,18``), ``fault`` (kinds: :data:`~escape_sim.emulators.asm.server.FAULT_KINDS`),
    ``transition_speed`` (factor on the speed of state transitions), ``hold_s`` and ``rest_s`` (watchdog,
    seconds), ``versions`` (lowest and highest supported, ``1,1``).
    """

    def __init__(self, request: EmulatorRequest) -> None:
        options = AsmEmulatorOptions.from_request(request)
        config = request.config or load_system(options.system)
        dm = config.devices.dm
        bench = shared_bench(config, request.shared) if request.shared is not None else None
        hold_s, rest_s = (HOLD_S, REST_S) if bench is None else (TWIN_HOLD_S, TWIN_REST_S)
        actuators: MovingActuators = bench or RealTimeActuators(dm.n_act, config.twin.mirror.settling_s)
        noise = np.random.default_rng(np.random.SeedSequence(config.system.seed, spawn_key=(0xA5,)))
        limits, order = dm.limits, dm.hardware_order(config.twin.mirror.order)
        disabled = limits.disabled if order is None else np.flatnonzero(np.isin(order, limits.disabled))
        slew = limits.max_slew if limits.max_slew is not None else 2.0
        self.controller = AsmController(
            Shell(actuators, dm.n_act, dm.stroke_m, noise),
            AsmLimits(
                limits.max_stroke * dm.stroke_m, slew * dm.stroke_m,
                options.hold_s or hold_s, options.rest_s or rest_s,
            ),
            {*map(int, disabled), *_actuator_option(options.contaminated, dm.n_act)},
            speed=options.transition_speed,
            pass_time=None if bench is None else lambda s: bench.advance_to(bench.now_s + s),
        )  # fmt: skip
        faults = parse_fault_script(options.fault, AsmFault.from_text)
        low, high = map(int, options.versions.split(","))
        self.server = AsmServer(self.controller, dm.serial, faults, (low, high))
        self._host, self._port = request.host, PORT if request.port is None else request.port
        self._thread: threading.Thread | None = None
        self._loop: asyncio.AbstractEventLoop | None = None
        self._address = ""

    def start(self) -> str:
        """Listen; returns ``tcp HOST:PORT``, raises ConfigError if the address cannot be used."""
        if self._thread is not None:
            return self._address
        loop = asyncio.new_event_loop()
        try:
            port = loop.run_until_complete(self.server.listen(self._host, self._port))
        except OSError as error:
            loop.close()
            raise ConfigError(
                f"cannot listen on {self._host}:{self._port} ({error}); choose another --port (0: any) or "
                "--host"
            ) from error
        self._loop, self._address = loop, f"tcp {self._host}:{port}"
        self._thread = threading.Thread(target=loop.run_forever, name="asm emulator", daemon=True)
        self._thread.start()
        return self._address

    def stop(self) -> None:
        """Close all connections and stop listening; may be repeated. Leaves a thread that does not answer."""
        thread, loop = self._thread, self._loop
        self._thread = self._loop = None
        if thread is None or loop is None:
            return
        # Threads of this kind no longer run while Python ends, although they count as alive.
        if thread.is_alive() and not sys.is_finalizing():
            ending = asyncio.run_coroutine_threadsafe(self.server.shut_down(), loop)
            with contextlib.suppress(TimeoutError):
                ending.result(STOP_S)
            loop.call_soon_threadsafe(loop.stop)
            thread.join(STOP_S)
        elif not loop.is_running():
            loop.run_until_complete(self.server.shut_down())
        if not loop.is_running():
            loop.close()

    def inject(self, text: str) -> None:
        """Apply a fault of the mirror now, such as ``contaminate:17``; raises ``ConfigError`` if unknown."""
        fault = AsmFault.from_text(text)
        if self._loop is not None:
            self._loop.call_soon_threadsafe(self.server.apply_mirror_fault, fault)

    @property
    def violations(self) -> tuple[str, ...]:
        """Violations of the protocol by clients, in order."""
        return tuple(self.server.violations)

    def report(self) -> dict[str, Any]:
        """Counters and the mirror's present state."""
        controller, server = self.controller, self.server
        return {
            "state": str(controller.shell.state),
            "fault": controller.shell.fault,
            "last_event": controller.last_event,
            "note": controller.last_event,  # name of version 0.1.0
            "applied": controller.applied,
            "skipped": controller.skipped,
            "requests": server.requests,
            "damaged_frames": server.damaged,
        }


def _actuator_option(text: str, n_act: int) -> set[int]:
    numbers = [part.strip() for part in text.split(",") if part.strip()]
    if not all(part.isdigit() and int(part) < n_act for part in numbers):
        raise ConfigError(f"--option contaminated={text}: write numbers of actuators, 0 to {n_act - 1}")
    return {int(part) for part in numbers}
