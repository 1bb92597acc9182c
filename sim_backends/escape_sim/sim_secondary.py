"""Twin of an adaptive secondary mirror."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.api.mirror import DMInfo
from escape_sim.devices import shared_bench
from escape_sim.shell import AMBIENT_C, RISE_C_PER_A, STEP_S, Shell
from escape_sim.sim_bench import SimBench

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig


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
        self._info = dm.info("simulated MMT adaptive secondary", simulated=True)
        noise = np.random.SeedSequence(bench.config.system.seed, spawn_key=(0xA5,))
        self._shell = Shell(bench, dm.n_act, dm.stroke_m, np.random.default_rng(noise))

    @property
    def info(self) -> DMInfo:
        """Identity and geometry."""
        return self._info

    def now_ns(self) -> int:
        """Simulated time in nanoseconds."""
        return self._bench.now_ns

    def trip(self, reason: str) -> None:
        """Play a fault: coils off, the shell falls back on its reference body, latched."""
        self._shell.trip(reason)

    def _open(self) -> None:
        """Nothing to connect."""

    def _close(self) -> None:
        """The mirror stays as it is."""

    def _drive(self, command: NDArray[np.float64]) -> None:
        self._bench.drive(command)

    def _state(self) -> ShellState:
        return self._shell.state

    def _step(self, state: ShellState) -> None:
        self._bench.advance_to(self._bench.now_s + STEP_S[state])
        self._shell.arrive(state, self.flat)

    def _recover(self) -> None:
        self._shell.recover()

    def _measure(self) -> NDArray[np.float64]:
        return self._shell.measured()

    def _glance(self) -> ShellHealth:
        return self._health()

    def _health(self) -> ShellHealth:
        shell = self._shell
        current = float(shell.currents_a().max())
        return ShellHealth(
            self._bench.now_ns, shell.state, shell.gap_m(), current, AMBIENT_C + RISE_C_PER_A * current, 0,
            shell.fault,
        )  # fmt: skip
