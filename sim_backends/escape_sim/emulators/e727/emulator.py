"""Emulator ``e727``: PI's tip-tilt controller on the network, a serial line or USB."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.emulator import Emulator, EmulatorRequest
from escape_hw.errors import ConfigError
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.state import ControllerSettings
from escape_sim.emulators.e727.transports import FaultInjector, PtyServer, TcpServer, parse_fault_script

if TYPE_CHECKING:
    from escape_sim.emulators.e727.transports import E727Server

#: Port of the real controller.
PORT = 50000
_OPTIONS = ("serial", "auto-zero", "zeroed", "fault")


def make_emulator(request: EmulatorRequest) -> E727Emulator:
    """Entry point ``e727``.

    Raises
    ------
    ConfigError
        An option is unknown or wrong.
    """
    return E727Emulator(request)


class E727Emulator(Emulator):
    """A PI E-727 with an S-330 on its wire.

    Options: ``serial``; ``auto-zero``, its duration in seconds; ``zeroed=1``, auto-zero was done before;
    ``fault``, such as ``drop@12,close@40`` (see :mod:`escape_sim.emulators.e727.transports`).

    Parameters
    ----------
    request
        Where to answer and which controller to be.

    Attributes
    ----------
    controller
        What answers.
    """

    def __init__(self, request: EmulatorRequest) -> None:
        self.controller = E727Controller(_parse_options(request))
        faults = FaultInjector(parse_fault_script(request.options.get("fault", "")))
        self.server: E727Server = (
            PtyServer(self.controller, faults)
            if request.pty
            else TcpServer(
                self.controller, faults, request.host, PORT if request.port is None else request.port
            )
        )
        if request.shared is not None and request.config is not None:
            self._attach_to_twin(request.config, request.shared)

    def _attach_to_twin(self, config: Any, shared: dict[str, object]) -> None:
        """From now on the twin's beam goes where this stage points, where there is a twin."""
        # Imported here: an emulator that stands alone needs no optics.
        from escape_sim.devices.twins import existing_bench

        bench = existing_bench(shared)
        if bench is None:
            return
        urad = 1e-6
        centre = self.controller.settings.travel / 2
        section = config.devices.modulator
        gains = np.array(section.stage.axis_gain)

        def to_tilt(places: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((places - centre) * urad * gains)

        bench.beam_path.follow_stage(self.controller.steady_cycle, to_tilt)

    def start(self) -> str:
        """Begin to listen; returns where."""
        return self.server.start()

    def stop(self) -> None:
        """Hang up and stop listening."""
        self.server.stop()

    @property
    def complaints(self) -> tuple[str, ...]:
        """What clients did that a careful driver would not."""
        return tuple(self.controller.state.complaints)

    def report(self) -> dict[str, Any]:
        """Counters and condition."""
        return {**self.controller.report(), "left": self.server.client_session.final_condition}


def _parse_options(request: EmulatorRequest) -> ControllerSettings:
    options, defaults = request.options, ControllerSettings()
    unknown = [key for key in options if key not in _OPTIONS]
    if unknown:
        raise ConfigError(f"e727 has no option {unknown[0]!r}; it has {', '.join(_OPTIONS)}")
    try:
        seconds = float(options.get("auto-zero", defaults.auto_zero_s))
    except ValueError:
        raise ConfigError(f"auto-zero={options['auto-zero']}: give its duration in seconds") from None
    if not 0 < seconds <= 600:
        raise ConfigError(f"auto-zero={seconds:g}: it takes between 0 and 600 seconds")
    if options.get("zeroed", "0") not in ("0", "1"):
        raise ConfigError(f"zeroed={options['zeroed']}: write 0 or 1")
    return ControllerSettings(
        options.get("serial", defaults.serial), auto_zero_s=seconds, zeroed=options.get("zeroed") == "1"
    )
