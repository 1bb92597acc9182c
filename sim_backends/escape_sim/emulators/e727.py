"""Emulator ``e727``: PI's tip-tilt controller on the network, a serial line or USB."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.emulator import Emulator, EmulatorRequest
from escape_hw.errors import ConfigError
from escape_sim.emulators.e727_controller import Controller
from escape_sim.emulators.e727_state import Make
from escape_sim.emulators.e727_wires import PtyServer, TcpServer
from escape_sim.emulators.faults import FaultyWire, parse

if TYPE_CHECKING:
    from escape_sim.emulators.e727_wires import Server

#: Port of the real controller.
PORT = 50000
_OPTIONS = ("serial", "auto-zero", "zeroed", "fault")


def make_emulator(request: EmulatorRequest) -> E727:
    """Entry point ``e727``.

    Raises
    ------
    ConfigError
        An option is unknown or wrong.
    """
    return E727(request)


class E727(Emulator):
    """A PI E-727 with an S-330 on its wire.

    Options: ``serial``; ``auto-zero``, its duration in seconds; ``zeroed=1``, auto-zero was done before;
    ``fault``, such as ``drop@12,close@40`` (see :mod:`escape_sim.emulators.faults`).

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
        self.controller = Controller(_make(request))
        faults = FaultyWire(parse(request.options.get("fault", "")))
        self.server: Server = (
            PtyServer(self.controller, faults)
            if request.pty
            else TcpServer(
                self.controller, faults, request.host, PORT if request.port is None else request.port
            )
        )
        if request.shared is not None and request.config is not None:
            self._join(request.config, request.shared)

    def _join(self, config: Any, shared: dict[str, object]) -> None:
        """From now on the twin's beam goes where this stage points, where there is a twin."""
        # Imported here: an emulator that stands alone needs no optics.
        from escape_sim.devices import present_bench

        bench = present_bench(shared)
        if bench is None:
            return
        urad = 1e-6
        centre = self.controller.make.travel / 2
        section = config.devices.modulator
        gains = np.array(section.stage.axis_gain)

        def track(places: NDArray[np.float64]) -> NDArray[np.float64]:
            return np.asarray((places - centre) * urad * gains)

        bench.beam_circle.follow(self.controller.turn, track)

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
        return {**self.controller.report(), "left": self.server.conversation.left}


def _make(request: EmulatorRequest) -> Make:
    options, usual = request.options, Make()
    unknown = [key for key in options if key not in _OPTIONS]
    if unknown:
        raise ConfigError(f"e727 has no option {unknown[0]!r}; it has {', '.join(_OPTIONS)}")
    try:
        seconds = float(options.get("auto-zero", usual.auto_zero_s))
    except ValueError:
        raise ConfigError(f"auto-zero={options['auto-zero']}: give its duration in seconds") from None
    if not 0 < seconds <= 600:
        raise ConfigError(f"auto-zero={seconds:g}: it takes between 0 and 600 seconds")
    if options.get("zeroed", "0") not in ("0", "1"):
        raise ConfigError(f"zeroed={options['zeroed']}: write 0 or 1")
    return Make(options.get("serial", usual.serial), auto_zero_s=seconds, zeroed=options.get("zeroed") == "1")
