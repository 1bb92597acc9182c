"""Faults of the wires to an adaptive secondary (TCP) and a modulator (TCP, serial), at random moments."""

from __future__ import annotations

import itertools
import random
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from campaign_table import Campaign

from escape_drivers.asm.mirror import AsmMirror
from escape_drivers.pi.modulator import PiModulator
from escape_drivers.pi.transports import SerialTransport, TcpTransport
from escape_hw.api.adaptive_secondary import ShellState
from escape_hw.api.emulator import EmulatorRequest
from escape_hw.api.modulator import Modulation
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext
from escape_hw.errors import DeviceError
from escape_sim.emulators.asm.emulator import AsmEmulator, make_emulator
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.state import ControllerSettings
from escape_sim.emulators.e727.transports import FAULT_KINDS, FaultInjector, PtyServer, TcpServer

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(3000)]

SEED = 1400
#: Trials, and faults of each.
N_ASM, N_E727, MOST_FAULTS = 120, 60, 3
#: Faults of the secondary's link, and of the mirror.
LINK = ("close", "reset", "stall", "delay:0.3", "truncate", "crc", "stale", "double", "garbage")
MIRROR = ("skip", "contaminate:17", "unreadable:30", "overcurrent:40", "watchdog", "trip")
#: Off, at rest, or coils off after a fault; set, the shell floats flat under its own control.
SAFE = (ShellState.OFF, ShellState.RESTED, ShellState.SET, ShellState.FAULT)
#: Longest wait for something that takes a second on an idle computer, seconds.
PATIENCE_S = 60.0


def wait_for(condition: Callable[[], bool]) -> bool:
    """Whether something becomes true."""
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            return False
        time.sleep(0.01)
    return True


# --------------------------------------------------------------------- the adaptive secondary
def use_secondary(fault: str) -> str:
    """A session on an emulated secondary with faults; its outcome begins with ``failed`` if it is bad."""
    options = {"transition_speed": "1000", "hold_s": "0.3", "rest_s": "1.0", "fault": fault}
    emulator = make_emulator(EmulatorRequest(port=0, options=options))
    assert isinstance(emulator, AsmEmulator)
    with emulator:
        mirror = secondary(int(emulator.start().rpartition(":")[2]))
        message = ""
        try:
            with mirror:
                for k in range(8):
                    mirror.send(0.005 * k * np.ones(336))
                mirror.measured_positions()
                mirror.flatten()
        except DeviceError as error:
            message = str(error)
        except Exception as error:
            return f"failed: {type(error).__name__}: {error}"
        controller = emulator.controller
        if mirror.is_open:
            return "failed: still open"
        if not wait_for(lambda: controller.shell.state in SAFE):
            return f"failed: the shell is {controller.shell.state}"
        shapes = [np.asarray(shape) for name, shape in emulator.server.calls if name == "COMMAND"]
        if any(one.any() and np.array_equal(one, other) for one, other in itertools.pairwise(shapes)):
            return "failed: a command came twice"
    return "error, shell safe" if message else "no effect"


def secondary(port: int) -> AsmMirror:
    options = [f"devices.dm.options.{key}" for key in (f"port={port}", "reply_s=1.0", "heartbeat_s=600.0")]
    config = load_system("maps-nir", overrides=["devices.dm.mode=hardware", *options])
    return AsmMirror.from_section(config.devices.dm, DeviceContext("dm", config))


def test_faults_of_an_adaptive_secondary(campaign: Campaign) -> None:
    rng = random.Random(SEED)
    scripts = [
        ",".join(
            f"{rng.choice(LINK if rng.random() < 0.8 else MIRROR)}@{rng.randrange(40)}"
            for _ in range(rng.randint(1, MOST_FAULTS))
        )
        for _ in range(N_ASM)
    ]
    with ThreadPoolExecutor(8) as pool:
        for script, outcome in zip(scripts, pool.map(use_secondary, scripts), strict=True):
            if outcome.startswith("failed"):
                campaign.fail(f"{script}: {outcome}")
            else:
                campaign.count(outcome)
    campaign.end("faults of link and mirror of an adaptive secondary, over TCP")


# --------------------------------------------------------------------- the modulator
CIRCLE = Modulation(1.41e-4, 303.03)
#: The emulated stage lives this many times faster.
HURRY, TIMEOUT_S = 20.0, 0.3


class Stage:
    """An emulated controller on a wire, and drivers for it."""

    def __init__(self, wire: str, faults: dict[int, str]) -> None:
        settings = ControllerSettings(serial="SIMMOD", zeroed=True, auto_zero_s=2.0)
        self.controller = E727Controller(settings, lambda: HURRY * time.monotonic())
        self.faults = FaultInjector(faults)
        self.server = (
            TcpServer(self.controller, self.faults, "127.0.0.1", 0)
            if wire == "tcp"
            else PtyServer(self.controller, self.faults)
        )
        self._address = self.server.start().partition(" ")[2]
        overrides = ["devices.modulator.stage.settle_s=0.5"]
        section = load_system("razor-pywfs", overrides=overrides).devices.modulator
        assert section is not None
        self._section = section

    def driver(self) -> PiModulator:
        return PiModulator(
            "SIMMOD", name="stage", stage=self._section.stage, max_tilt_rad=self._section.max_tilt_rad,
            connect=self._connect, sleep=lambda s: time.sleep(s / HURRY), timeout_s=TIMEOUT_S,
        )  # fmt: skip

    def _connect(self) -> SerialTransport | TcpTransport:
        host, colon, port = self._address.rpartition(":")
        if colon:
            return TcpTransport(host, int(port), 2.0, 2.0)
        return SerialTransport(self._address, 115200, 2.0)

    def restore(self) -> None:
        """End the faults, and plug the cable in again."""
        self.faults.__init__({})  # type: ignore[misc]
        if isinstance(self.server, PtyServer):
            self.server.stop()
            self._address = self.server.start().partition(" ")[2]

    @property
    def condition(self) -> str:
        return self.controller.state.describe()


def use_stage(stage: Stage) -> str:
    """A session with faults, and one after them; the outcome, which begins with ``failed`` if it is none."""
    driver, failures = stage.driver(), []
    for call in (driver.open, lambda: driver.modulate(CIRCLE), driver.park, driver.close):
        try:
            call()
        except DeviceError as error:
            failures.append(str(error))
        except Exception as error:
            return f"failed: {type(error).__name__}: {error}"
        if call == driver.open and not driver.is_open:
            break
    if driver.is_open:
        return "failed: still open"
    stage.restore()
    try:
        with stage.driver() as again:
            again.modulate(CIRCLE)
            if stage.condition != "turning":
                return f"failed: {stage.condition} after 'modulate' of the next session"
    except DeviceError as error:
        return f"failed: the next session: {error}"
    if not wait_for(lambda: stage.condition == "at rest"):
        return f"failed: {stage.condition} in the end"
    return "error, next session good" if failures else "no effect"


@pytest.mark.parametrize("wire", ["tcp", "serial"])
def test_faults_of_a_modulator(campaign: Campaign, wire: str) -> None:
    rng = random.Random(SEED)
    for _ in range(N_E727):
        faults = {rng.randrange(120): rng.choice(FAULT_KINDS) for _ in range(rng.randint(1, MOST_FAULTS))}
        stage = Stage(wire, faults)
        try:
            outcome = use_stage(stage)
        finally:
            stage.server.stop()
        if outcome.startswith("failed"):
            campaign.fail(f"{faults}: {outcome}")
        else:
            campaign.count(outcome)
    campaign.end(f"faults of the E-727, over {'TCP' if wire == 'tcp' else 'a serial line'}")
