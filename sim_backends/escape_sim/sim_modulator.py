"""Twin of the tip-tilt modulator in front of the pyramid."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from escape_hw.api.modulator import Modulation, ModulatorInfo, TipTiltModulator
from escape_hw.config.sensor_models import PyramidSection
from escape_hw.errors import ConfigError, SettingRejected
from escape_sim.devices import shared_bench
from escape_sim.sim_bench import SimBench

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Servo clock of the controller; a turn is a whole number of its steps.
SERVO_S = 50e-6
#: Fewest and most steps of a turn: a kilohertz is all that a loaded stage does, and its memory ends.
_STEPS = (20, 262_144)


def make_modulator(name: str, config: SystemConfig, shared: dict[str, object]) -> SimModulator:
    """Entry point ``sim-e727``."""
    return SimModulator(name, shared_bench(config, shared))


class SimModulator(TipTiltModulator):
    """Twin of the PI S-330 with its E-727: a frequency that the servo clock rounds, a slow start.

    It says what it was told to do, as the real one does: the ellipse, the lag between its axes and
    the drift of its centre are seen by the beam only (``twin.pyramid``).
    """

    def __init__(self, name: str, bench: SimBench) -> None:
        super().__init__(name)
        section = bench.config.devices.modulator
        if section is None:
            raise ConfigError(f"system {bench.config.system.name!r} has no [devices.modulator] section")
        bench.config.sensor_as(PyramidSection)
        self._bench = bench
        self._info = ModulatorInfo(
            "simulated PI S-330 with E-727", section.serial, section.max_tilt_rad, True
        )

    @property
    def info(self) -> ModulatorInfo:
        """Identity and reach."""
        return self._info

    @property
    def modulation(self) -> Modulation | None:
        """The modulation in force."""
        return self._bench.beam_circle.modulation

    def now_ns(self) -> int:
        """Simulated time in nanoseconds."""
        return self._bench.now_ns

    def _open(self) -> None:
        """Nothing to connect; the stage is parked."""

    def _close(self) -> None:
        """Nothing to release."""

    def _check(self, want: Modulation) -> Modulation:
        steps = round(1 / (want.frequency_hz * SERVO_S))
        least, most = _STEPS
        if not least <= steps <= most:
            raise SettingRejected(
                self.name,
                f"frequency_hz is {want.frequency_hz:g}; it does {1 / (most * SERVO_S):.2g} to "
                f"{1 / (least * SERVO_S):g} Hz",
            )
        return replace(want, frequency_hz=1 / (steps * SERVO_S))

    def _modulate(self, modulation: Modulation) -> None:
        bench = self._bench
        bench.advance_to(bench.now_s + bench.config.twin.pyramid.start_s)
        bench.beam_circle.modulation = modulation

    def _park(self) -> None:
        self._bench.beam_circle.modulation = None
