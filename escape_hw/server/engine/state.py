"""What the engine's threads know of each other: written by one, read by all."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.calibration.loop.control import LoopControl
from escape_hw.config.system import SystemConfig
from escape_hw.errors import RequestRefused
from escape_hw.io.provenance import format_utc
from escape_hw.remote.state import ActiveRun, FaultState, FinishedRun, Phase


@dataclass(frozen=True, slots=True)
class LoopSettings:
    """How the loop is closed, or would be; the matrix by its name."""

    matrix: str = ""
    gain: float = 0.0
    leak: float = 0.0
    dropped_modes: int = 0

    @classmethod
    def from_config(cls, config: SystemConfig, matrix: str = "") -> LoopSettings:
        """As the configuration has it."""
        loop = config.loop
        return cls(matrix, loop.gain, loop.leak, loop.dropped_modes)


@dataclass(slots=True)
class EngineState:
    """The engine's present condition.

    Parameters
    ----------
    stop
        Set it to stop what runs.
    paused
        Whether the procedure is asked to halt.
    closed
        Whether the loop is closed.
    orders, loop_metrics
        What a loop that stays closed is asked, and what it tells of itself.
    complaints
        What devices were last heard to complain of, by name.
    """

    loop: LoopSettings
    phase: Phase = Phase.STARTING
    fault: FaultState | None = None
    running: ActiveRun | None = None
    last: FinishedRun | None = None
    stop: SignalSafeFlag = field(default_factory=SignalSafeFlag)
    paused: bool = False
    closed: bool = False
    loop_control: LoopControl | None = None
    loop_statistics: dict[str, float] = field(default_factory=dict)
    needs_loop: bool = False
    device_messages: dict[str, str] = field(default_factory=dict)
    lock: threading.Lock = field(default_factory=threading.Lock)

    def latch_fault(self, reason: str, way_out: str) -> None:
        """Remember why the mirror was made safe; the first reason stays."""
        if self.fault is None:
            self.fault = FaultState(reason=reason, at_utc=format_utc(), way_out=way_out)

    def require_idle(self) -> None:
        """Raise unless something may be started.

        Raises
        ------
        RequestRefused
            Says what is in the way.
        """
        if self.fault is not None:
            raise RequestRefused(f"made safe: {self.fault.reason}; clear the fault first")
        if self.running is not None:
            raise RequestRefused(
                f"'{self.running.name}' (run {self.running.id}) is running; abort it, or wait"
            )
        if self.phase is Phase.LOOP:
            raise RequestRefused("the loop is closed; open it first")
        if self.phase is not Phase.IDLE:
            raise RequestRefused(f"the engine is {self.phase.value}; wait a moment")
