"""State of the engine: an immutable snapshot, and every transition as an atomic method."""

from __future__ import annotations

import functools
import math
import threading
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Concatenate, ParamSpec, TypeVar

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.api.procedure import Progress
from escape_hw.calibration.loop.control import LoopControl
from escape_hw.config.system import SystemConfig
from escape_hw.errors import RequestRefused
from escape_hw.io.provenance import format_utc
from escape_hw.remote.state import ActiveRun, FaultState, Finish, FinishedRun, Phase

#: Number of a poke in the place of that of a run.
POKE_ID = 0


@dataclass(frozen=True, slots=True)
class LoopParameters:
    """Parameters of the loop; ``matrix`` is a name in the product store."""

    matrix: str = ""
    gain: float = 0.0
    leak: float = 0.0
    dropped_modes: int = 0

    @classmethod
    def from_config(cls, config: SystemConfig, matrix: str = "") -> LoopParameters:
        """The configured parameters."""
        loop = config.loop
        return cls(matrix, loop.gain, loop.leak, loop.dropped_modes)


@dataclass(frozen=True, slots=True)
class EngineSnapshot:
    """State of the engine at one moment."""

    #: Parameters of the loop, closed or not.
    loop: LoopParameters
    phase: Phase = Phase.STARTING
    fault: FaultState | None = None
    active_run: ActiveRun | None = None
    last_run: FinishedRun | None = None
    #: Whether the operator asked the procedure to pause.
    paused: bool = False
    loop_closed: bool = False
    #: Whether the present activity works in closed loop.
    needs_loop: bool = False
    #: Control of the loop outside procedures, and its newest metrics; ``None`` and empty when there is none.
    loop_control: LoopControl | None = None
    loop_statistics: Mapping[str, float] = field(default_factory=dict)
    #: Newest problem of each device, by its key in ``[devices]``.
    device_messages: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class RunTicket:
    """Permission to run a procedure: the run, its stop flag, and the loop to close again after it."""

    run: ActiveRun
    stop: SignalSafeFlag
    loop_before: LoopParameters | None


S = TypeVar("S", bound="EngineState")
P = ParamSpec("P")
R = TypeVar("R")


def _atomic(method: Callable[Concatenate[S, P], R]) -> Callable[Concatenate[S, P], R]:
    """Run a method under the state's lock."""

    @functools.wraps(method)
    def locked(self: S, /, *args: P.args, **kwargs: P.kwargs) -> R:
        with self._lock:
            return method(self, *args, **kwargs)

    return locked


class EngineState:
    """State of the engine, shared by its threads.

    Readers take :attr:`snapshot`. Each transition is one method, atomic under the only lock.
    """

    def __init__(self, loop: LoopParameters, first_run_id: int = 1) -> None:
        self._now = EngineSnapshot(loop)
        self._stop = SignalSafeFlag()
        self._next_run_id = first_run_id
        self._lock = threading.Lock()

    @property
    def snapshot(self) -> EngineSnapshot:
        """The present state."""
        return self._now

    @property
    def stop_requested(self) -> bool:
        """Whether the present activity has to stop."""
        return self._stop.is_set()

    def _set(self, **changes: Any) -> None:
        self._now = replace(self._now, **changes)

    # ------------------------------------------------------------ devices and faults
    @_atomic
    def set_phase(self, phase: Phase) -> None:
        """Enter a phase; :attr:`Phase.IDLE` when the devices are open and the mirror is flat."""
        self._set(phase=phase, device_messages={} if phase is Phase.IDLE else self._now.device_messages)

    @_atomic
    def clear_fault(self) -> None:
        """Release the latched fault."""
        self._set(fault=None)

    @_atomic
    def set_device_message(self, device: str, message: str = "") -> None:
        """Store the problem of a device; an empty message removes it."""
        if self._now.device_messages.get(device, "") != message:
            others = {name: text for name, text in self._now.device_messages.items() if name != device}
            self._set(device_messages={**others, device: message} if message else others)

    @_atomic
    def latch_fault(self, reason: str, remedy: str) -> None:
        """Latch a fault and stop the present activity. A fault that is latched already stays."""
        self._latch(reason, remedy)
        self._stop.set()

    @_atomic
    def enter_fault(self, reason: str, remedy: str) -> None:
        """Latch a fault; the loop is open and the mirror is being made safe."""
        self._latch(reason, remedy)
        self._set(phase=Phase.FAULT, loop_closed=False)

    def _latch(self, reason: str, remedy: str) -> None:
        if self._now.fault is None:
            self._set(fault=FaultState(reason=reason, at_utc=format_utc(), remedy=remedy))

    # ------------------------------------------------------------ stop
    @_atomic
    def request_stop(self) -> None:
        """Stop the present activity."""
        self._stop.set()

    @_atomic
    def request_abort(self) -> bool:
        """Stop the procedure; false when none runs."""
        if self._now.active_run is None:
            return False
        self._stop.set()
        return True

    @_atomic
    def request_open_loop(self) -> bool:
        """Stop whatever closes the loop; false when a procedure runs that works in open loop."""
        if self._now.active_run is not None and not self._now.needs_loop:
            return False
        self._stop.set()
        return True

    # ------------------------------------------------------------ procedures
    def check_can_start(self, needs_loop: bool) -> LoopParameters | None:
        """Check that a procedure can start; returns the loop to close again after it.

        RequestRefused when a fault is latched or something else runs.
        """
        now = self._now
        restorable = now.loop_control is not None and now.fault is None and now.active_run is None
        if needs_loop and restorable and not self._stop.is_set():
            return now.loop
        self._require_idle()
        return None

    def _require_idle(self) -> None:
        now = self._now
        if now.fault is not None:
            raise RequestRefused(f"a fault is latched: {now.fault.reason}; clear the fault first")
        if now.active_run is not None:
            raise RequestRefused(
                f"'{now.active_run.name}' (run {now.active_run.id}) is running; abort it, or wait for its end"
            )
        if now.phase is Phase.LOOP:
            raise RequestRefused("the loop is closed; open it first")
        if now.phase is not Phase.IDLE:
            raise RequestRefused(f"the engine is {now.phase.value}; wait until it is idle")

    @_atomic
    def begin_run(self, name: str, arguments: dict[str, Any], needs_loop: bool) -> RunTicket:
        """Reserve the engine for a procedure, see :meth:`check_can_start`; opens a closed loop."""
        loop_before = self.check_can_start(needs_loop)
        if self._now.loop_control is not None:
            self._now.loop_control.request_open()
        run = ActiveRun(
            id=self._next_run_id, name=name, arguments=arguments, stage="starting",
            started_utc=format_utc(),
        )  # fmt: skip
        self._next_run_id += 1
        self._stop = SignalSafeFlag()
        self._set(active_run=run, phase=Phase.PROCEDURE, paused=False, needs_loop=needs_loop)
        return RunTicket(run, self._stop, loop_before)

    @_atomic
    def check_idle(self) -> None:
        """Check that nothing runs and no fault is latched (RequestRefused)."""
        self._require_idle()

    @_atomic
    def begin_poke(self, description: str) -> SignalSafeFlag:
        """Reserve the engine for a poke, which is no run with a folder; returns its stop flag."""
        self._require_idle()
        self._stop = SignalSafeFlag()
        poke = ActiveRun(
            id=POKE_ID, name="poke", arguments={}, stage=description, unit="second", started_utc=format_utc()
        )
        self._set(active_run=poke, phase=Phase.PROCEDURE, paused=False, needs_loop=False)
        return self._stop

    @_atomic
    def end_poke(self) -> None:
        """The poke has ended, and the mirror is flat."""
        self._set(active_run=None, phase=Phase.IDLE if self._now.fault is None else Phase.FAULT)

    @_atomic
    def set_loop_closed(self, closed: bool) -> None:
        """Note that the loop is closed, or open."""
        self._set(loop_closed=closed)

    @_atomic
    def finish_run(
        self, finished: FinishedRun, next_loop: tuple[LoopParameters, LoopControl] | None = None
    ) -> SignalSafeFlag | None:
        """End the run and, where ``next_loop`` is given and nothing speaks against it, begin that loop.

        Returns its stop flag; ``None`` when the loop stays open.
        """
        fault = self._now.fault
        phase = Phase.IDLE if fault is None else Phase.FAULT
        self._set(
            active_run=None, last_run=finished, phase=phase, paused=False, needs_loop=False,
            loop_closed=False,
        )  # fmt: skip
        undisturbed = finished.finish is Finish.DONE and fault is None and not self._stop.is_set()
        return self._begin_loop(*next_loop) if next_loop is not None and undisturbed else None

    @_atomic
    def pause(self) -> None:
        """Ask the procedure to pause (RequestRefused: no procedure runs, or it works in closed loop)."""
        run = self._require_run()
        if run.id == POKE_ID:
            raise RequestRefused("a poke ends by itself and cannot be paused; abort it")
        if self._now.needs_loop:
            raise RequestRefused(f"'{run.name}' works in closed loop and cannot be paused; abort it")
        self._set(paused=True)

    @_atomic
    def resume(self) -> None:
        """Ask the procedure to resume (RequestRefused: no procedure runs)."""
        self._require_run()
        self._set(paused=False)

    def _require_run(self) -> ActiveRun:
        if self._now.active_run is None:
            raise RequestRefused("no procedure is running")
        return self._now.active_run

    @_atomic
    def mark_run_paused(self, paused: bool) -> None:
        """Note in the active run whether it is paused."""
        if self._now.active_run is not None:
            self._set(active_run=self._now.active_run.model_copy(update={"paused": paused}))

    @_atomic
    def update_progress(self, progress: Progress) -> ActiveRun | None:
        """Store progress; returns the run of a procedure, ``None`` for the loop."""
        if self._now.loop_control is not None:
            self._set(loop_statistics=dict(progress.metrics))
            return None
        if self._now.active_run is None:
            return None
        left = progress.remaining_s
        run = self._now.active_run.model_copy(
            update={
                "stage": progress.stage, "completed": progress.done, "total": progress.total,
                "unit": progress.unit, "elapsed_s": progress.elapsed_s,
                "remaining_s": left if math.isfinite(left) else None,
                "metrics": {k: float(v) for k, v in progress.metrics.items() if math.isfinite(v)},
            }
        )  # fmt: skip
        self._set(active_run=run)
        return run

    # ------------------------------------------------------------ the loop outside procedures
    @_atomic
    def begin_loop(self, settings: LoopParameters, control: LoopControl) -> SignalSafeFlag:
        """Reserve the engine for a loop, if it is idle; returns its stop flag."""
        self._require_idle()
        return self._begin_loop(settings, control)

    def _begin_loop(self, settings: LoopParameters, control: LoopControl) -> SignalSafeFlag:
        self._stop = SignalSafeFlag()
        self._set(loop=settings, loop_control=control, phase=Phase.LOOP, needs_loop=True)
        return self._stop

    @_atomic
    def end_loop(self) -> None:
        """The loop is open; a procedure that was accepted meanwhile may begin."""
        now = self._now
        self._set(
            loop_closed=False, loop_control=None, loop_statistics={},
            needs_loop=now.needs_loop and now.active_run is not None,
            phase=Phase.IDLE if now.phase is Phase.LOOP else now.phase,
        )  # fmt: skip

    @_atomic
    def set_loop_settings(self, settings: LoopParameters) -> None:
        """Store the parameters of the loop."""
        self._set(loop=settings)
