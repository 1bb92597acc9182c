"""Twin of an adaptive secondary mirror."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.api.mirror import DMInfo
from escape_sim.devices import shared_bench
from escape_sim.sim_bench import SimBench

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

#: Gap of the floating shell (paper: about 50 um) and of one that lies on its reference body, metres.
GAP_M, RESTED_GAP_M = 50e-6, 2e-6
#: Noise of a capacitive position sensor in metres.
SENSOR_NOISE_M = 3e-9
#: Time in seconds that each step of the ladder takes.
STEP_S = {ShellState.OFF: 0.5, ShellState.RESTED: 1.0, ShellState.SET: 2.0, ShellState.RUNNING: 0.1}
#: Coil current in amperes that holds the shell, and what full stroke against the stiff shell adds.
HOLD_A, STROKE_A = 0.05, 0.5


def make_secondary(name: str, config: SystemConfig, shared: dict[str, object]) -> SimAdaptiveSecondary:
    """Entry point ``sim-asm``."""
    return SimAdaptiveSecondary(name, shared_bench(config, shared))


class SimAdaptiveSecondary(AdaptiveSecondary):
    """Twin of the MMT's 336-actuator mirror: dynamics and latency as any twin, and a shell that floats.

    The option ``lift`` of its device section, true by default, says whether opening it leads to
    ``RUNNING``. :meth:`trip` plays a fault.
    """

    def __init__(self, name: str, bench: SimBench) -> None:
        dm = bench.config.devices.dm
        super().__init__(name, dm.limits.to_limits(), lift=bool(dm.options.get("lift", True)))
        self._bench = bench
        self._now_in = ShellState.OFF
        self._fault = ""
        self._noise = np.random.default_rng(
            np.random.SeedSequence(bench.config.system.seed, spawn_key=(0xA5,))
        )
        self._info = DMInfo(
            "simulated MMT adaptive secondary", dm.serial, dm.n_act, dm.actuator_map(),
            dm.positions() * dm.pitch_m, dm.stroke_m, True,
        )  # fmt: skip

    @property
    def info(self) -> DMInfo:
        """Identity and geometry."""
        return self._info

    def now_ns(self) -> int:
        """Simulated time in nanoseconds."""
        return self._bench.now_ns

    def trip(self, reason: str) -> None:
        """Play a fault: coils off, the shell falls back on its reference body, latched."""
        self._now_in, self._fault = ShellState.FAULT, reason
        self._bench.dynamics.command(self._bench.now_s, np.zeros(self._info.n_act))

    def _open(self) -> None:
        """Nothing to connect."""

    def _close(self) -> None:
        """The mirror stays as it is."""

    def _drive(self, command: NDArray[np.float64]) -> None:
        twin = self._bench.config.twin
        jitter = twin.latency_jitter_s * abs(self._bench.latency_rng.standard_normal())
        self._bench.dynamics.command(self._bench.now_s + twin.latency_s + jitter, command)

    def _state(self) -> ShellState:
        return self._now_in

    def _step(self, state: ShellState) -> None:
        self._bench.advance_to(self._bench.now_s + STEP_S[state])
        self._now_in = state
        # Afloat, the shell takes its flat shape; at rest it has that of its reference body.
        shape = self.flat if state in (ShellState.SET, ShellState.RUNNING) else np.zeros(self._info.n_act)
        self._bench.dynamics.command(self._bench.now_s, shape)

    def _recover(self) -> None:
        self._now_in, self._fault = ShellState.RESTED, ""

    def _measure(self) -> NDArray[np.float64]:
        true = self._bench.dynamics.at(self._bench.now_s)
        return true + self._noise.standard_normal(true.size) * (SENSOR_NOISE_M / self._info.stroke_m)

    def _health(self) -> ShellHealth:
        places = self._bench.dynamics.at(self._bench.now_s)
        floats = self._now_in in (ShellState.SET, ShellState.RUNNING)
        gap = GAP_M + float(places.mean()) * self._info.stroke_m if floats else RESTED_GAP_M
        current = HOLD_A + STROKE_A * float(np.abs(places).max()) if floats else 0.0
        return ShellHealth(
            self._bench.now_ns, self._now_in, gap, current, 15.0 + 10 * current, 0, self._fault
        )
