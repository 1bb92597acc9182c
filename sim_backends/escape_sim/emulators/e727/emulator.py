"""``escape emulate e727``: PI's tip-tilt controller on the network, a serial line or USB."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from escape_hw.api.emulator import Emulator, EmulatorRequest
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.state import ControllerSettings
from escape_sim.emulators.e727.transports import (
    E727Server,
    FaultInjector,
    PtyServer,
    TcpServer,
    parse_fault,
)
from escape_sim.emulators.options import EmulatorOptions, parse_fault_script

#: Port of the real controller.
PORT = 50000


def make_emulator(request: EmulatorRequest) -> E727Emulator:
    """Entry point ``e727``; raises ``ConfigError`` if an option is unknown or has no valid value."""
    return E727Emulator(request)


class E727Options(EmulatorOptions):
    """Options of :class:`E727Emulator`."""

    serial: str = ControllerSettings.serial
    auto_zero_s: float = Field(ControllerSettings.auto_zero_s, alias="auto-zero", gt=0, le=600)
    zeroed: Literal["0", "1"] = "0"
    fault: str = ""


class E727Emulator(Emulator):
    """An emulated PI E-727 with an S-330, as ``controller``.

    Options: ``serial``; ``auto-zero``, its duration in seconds; ``zeroed=1`` if auto-zero was done before;
    ``fault``, such as ``drop_reply@12,close@40`` (see :mod:`escape_sim.emulators.e727.transports`).
    """

    def __init__(self, request: EmulatorRequest) -> None:
        options = E727Options.from_request(request)
        self.controller = E727Controller(
            ControllerSettings(options.serial, auto_zero_s=options.auto_zero_s, zeroed=options.zeroed == "1")
        )
        faults = FaultInjector(parse_fault_script(options.fault, parse_fault))
        port = PORT if request.port is None else request.port
        self.server: E727Server = (
            PtyServer(self.controller, faults)
            if request.pty
            else TcpServer(self.controller, faults, request.host, port)
        )
        if request.shared is not None and request.config is not None:
            self._attach_to_twin(request.config, request.shared)

    def _attach_to_twin(self, config: Any, shared: dict[str, object]) -> None:
        """Let this stage move the beam of the simulated bench, if there is one."""
        # Imported here: without a bench the emulator needs no optics.
        from escape_sim.devices.twins import existing_bench

        bench = existing_bench(shared)
        if bench is None:
            return
        centre = self.controller.settings.travel / 2
        gains = np.array(config.devices.modulator.stage.axis_gain)

        def to_tilt(positions_urad: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((positions_urad - centre) * 1e-6 * gains)

        bench.beam_path.follow_stage(self.controller.steady_cycle, to_tilt)

    def start(self) -> str:
        """Start; returns the address."""
        return self.server.start()

    def stop(self) -> None:
        """Close the connection and stop listening; may be repeated."""
        self.server.stop()

    @property
    def violations(self) -> tuple[str, ...]:
        """Violations of the protocol by clients, in order."""
        return tuple(self.controller.state.violations)

    def report(self) -> dict[str, Any]:
        """Counters and conditions."""
        final = self.server.client_session.final_condition
        # "left" is the name of version 0.1.0.
        return {**self.controller.report(), "final_condition": final, "left": final}
