"""A driver and an emulated E-727 in one process, without delays and with an accelerated clock."""

from __future__ import annotations

import time

from usb_bus import UsbPipe

from escape_drivers.pi.modulator import PiModulator
from escape_drivers.pi.transports import TransportLost
from escape_hw.config.loader import load_system
from escape_sim.emulators.e727.controller import E727Controller
from escape_sim.emulators.e727.state import ControllerSettings
from escape_sim.emulators.e727.transports import FaultInjector

#: How many times faster than real the emulated stage lives; the longest wait for a reply.
HURRY, TIMEOUT_S = 40.0, 0.03


class Pipe:
    """Bytes from hand to hand; as a transport."""

    where = "pipe"

    def __init__(self, controller: E727Controller, wire: FaultInjector) -> None:
        self._usb, self._held = UsbPipe(controller, wire), b""
        self.is_open = False

    def open(self) -> None:
        self.is_open = self._usb.is_plugged = True

    def close(self) -> None:
        if self.is_open and self._usb.is_plugged:
            self._usb.client_session.finish()
        self.is_open = False

    def write(self, data: bytes) -> None:
        if not self.is_open:
            raise TransportLost("the pipe to the controller is closed; open it again")
        try:
            self._usb.write(data + b"\0" * (len(data) % 2))
        except ConnectionError:
            raise TransportLost("the pipe to the controller broke; join it and open again") from None

    def read(self, timeout_s: float) -> bytes:
        if not self._usb.is_plugged:
            raise TransportLost("the pipe to the controller broke; join it and open again")
        return self._usb.read(65536, timeout_s)


class Peers:
    """The emulated controller, and drivers for it."""

    def __init__(
        self, faults: dict[int, str] | None = None, *, zeroed: bool = True, correct: str = "none"
    ) -> None:
        make = ControllerSettings(serial="SIMMOD", zeroed=zeroed, auto_zero_s=2.0)
        self.controller = E727Controller(make, lambda: HURRY * time.monotonic())
        self.wire = FaultInjector(faults)
        overrides = [
            f'devices.modulator.stage.correction_source="{correct}"',
            "devices.modulator.stage.settle_s=0.5",
        ]
        section = load_system("razor-pywfs", overrides=overrides).devices.modulator
        assert section is not None
        self.section = section

    def driver(self) -> PiModulator:
        return PiModulator(
            "SIMMOD", name="stage", stage=self.section.stage, max_tilt_rad=self.section.max_tilt_rad,
            connect=lambda: Pipe(self.controller, self.wire), sleep=lambda s: time.sleep(s / HURRY),
            timeout_s=TIMEOUT_S,
        )  # fmt: skip

    @property
    def condition(self) -> str:
        return self.controller.state.describe()
