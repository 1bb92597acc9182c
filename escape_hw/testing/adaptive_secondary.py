"""Contract checks of adaptive secondary mirrors: states, faults, positions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from escape_hw.api.adaptive_secondary import STATE_ORDER, AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.errors import DeviceError
from escape_hw.testing.checks import NORMAL, READS, TINY, assert_refused, check, replace_hook
from escape_hw.testing.mirror import small_poke


@contextmanager
def _reporting_fault(mirror: AdaptiveSecondary) -> Iterator[None]:
    """Let the driver report a fault."""
    with ExitStack() as stack:
        for hook in ("_state", "_known_state"):
            stack.enter_context(replace_hook(mirror, hook, lambda: ShellState.FAULT))
        yield


@check(AdaptiveSecondary, NORMAL)
def check_secondary_reaches_every_state(mirror: AdaptiveSecondary) -> None:
    """``go_to`` reaches every state, up and down, and state and health agree."""
    for state in (*reversed(STATE_ORDER), *STATE_ORDER):
        mirror.go_to(state)
        assert mirror.state is state, f"go_to({state}) ended in {mirror.state}"
        reported = mirror.health.state
        assert reported is state, f"in {state} the health record has {reported}"


@check(AdaptiveSecondary, NORMAL)
def check_secondary_follows_commands_only_when_running(mirror: AdaptiveSecondary) -> None:
    """In other states a command is rejected, the shape is kept, and ``flatten`` does nothing."""
    for state in STATE_ORDER[:-1]:
        mirror.go_to(state)
        shape, sent = mirror.shape, mirror.sent_count
        assert_refused(mirror, DeviceError, f"a command while {state}", mirror.send, small_poke(mirror))
        mirror.flatten()
        assert np.array_equal(mirror.shape, shape), f"a command while {state} changed the shape"
        assert mirror.sent_count == sent, f"a command while {state} was counted as sent"
    mirror.go_to(ShellState.RUNNING)
    mirror.send(small_poke(mirror))


@check(AdaptiveSecondary, NORMAL)
def check_secondary_is_flat_after_rest(mirror: AdaptiveSecondary) -> None:
    """After a rest the shell is flat, for the mirror and for the guard."""
    mirror.go_to(ShellState.RUNNING)
    mirror.send(small_poke(mirror))
    mirror.go_to(ShellState.RESTED)
    mirror.go_to(ShellState.RUNNING)
    assert np.array_equal(mirror.shape, mirror.flat), "the shell is not flat after rest and start"


@check(AdaptiveSecondary, READS)
def check_secondary_refuses_fault_as_target(mirror: AdaptiveSecondary) -> None:
    """``go_to(FAULT)`` raises ``ValueError``."""
    state = mirror.state
    try:
        mirror.go_to(ShellState.FAULT)
    except ValueError:
        assert mirror.state is state, "go_to(FAULT) was rejected, but the state changed"
    else:
        raise AssertionError("go_to(FAULT) was accepted")


@check(AdaptiveSecondary, READS)
def check_secondary_measures_every_actuator(mirror: AdaptiveSecondary) -> None:
    """Positions are fractions of full stroke, one per actuator, NaN where unreadable."""
    positions = mirror.measured_positions()
    assert positions.dtype == np.float64, f"positions are {positions.dtype}, not float64"
    assert positions.shape == (mirror.info.n_act,), f"positions have shape {positions.shape}"
    assert not np.isinf(positions).any(), "a position is infinite; use NaN for unreadable positions"
    far = np.nanmax(np.abs(positions), initial=0.0)
    assert far < 10, f"a position is {far:.3g} full strokes; are they in metres or microns?"
    positions += 0.25
    again = mirror.measured_positions()
    assert not np.array_equal(again, positions, equal_nan=True), (
        "the mirror returned its own array instead of a copy"
    )


@check(AdaptiveSecondary, READS)
def check_secondary_reports_health(mirror: AdaptiveSecondary) -> None:
    """The health record is complete and finite, with and without control."""
    for what, health in (("health", mirror.health), ("observe_health()", mirror.observe_health())):
        assert isinstance(health, ShellHealth), f"{what} is {type(health).__name__}"
        numbers = (health.gap_m, health.current_a, health.temperature_c)
        assert all(math.isfinite(n) for n in numbers), f"{what} contains {numbers}"
        assert 0 <= health.gap_m < 1e-3, f"{what}: a gap of {health.gap_m} m"
        assert health.skipped >= 0, f"{what}: {health.skipped} commands skipped"
        assert health.state is not ShellState.FAULT or health.fault, f"{what}: a fault without a cause"


@check(AdaptiveSecondary, TINY)
def check_secondary_latches_faults(mirror: AdaptiveSecondary) -> None:
    """A latched fault prevents any motion, and the errors name ``recover``."""
    mirror.go_to(ShellState.RUNNING)
    shape = mirror.shape
    steps: list[ShellState] = []
    with _reporting_fault(mirror), replace_hook(mirror, "_step", steps.append):
        for what, call in (
            ("a command", lambda: mirror.send(small_poke(mirror))),
            ("going to running", lambda: mirror.go_to(ShellState.RUNNING)),
            ("going to rest", lambda: mirror.go_to(ShellState.RESTED)),
        ):
            refusal = assert_refused(mirror, DeviceError, f"{what} with a fault latched", call)
            assert "recover" in str(refusal), f"{what}: the message does not name recover(): {refusal}"
        mirror.flatten()
        assert not steps, f"with a fault latched it went to {steps}"
        assert np.array_equal(mirror.shape, shape), "with a fault latched the shape changed"


@check(AdaptiveSecondary, TINY)
def check_secondary_recovers_only_from_faults(mirror: AdaptiveSecondary) -> None:
    """``recover`` does nothing without a fault, and raises if the fault persists."""
    state = mirror.state
    calls: list[str] = []
    with replace_hook(mirror, "_recover", lambda: calls.append("recover")):
        mirror.recover()
        assert not calls, "recover() called the driver without a fault"
        with _reporting_fault(mirror):
            assert_refused(mirror, DeviceError, "recovery from a fault that persists", mirror.recover)
        assert calls, "recover() did not call the driver"
    assert mirror.state is state, (
        f"recover() changed the state from {state} to {mirror.state} without a fault"
    )


@check(AdaptiveSecondary, NORMAL)
def check_secondary_rests_when_closed(mirror: AdaptiveSecondary) -> None:
    """Closing rests the shell, or leaves it set with ``leave_set``."""
    for leave_set, last in ((False, ShellState.RESTED), (True, ShellState.SET)):
        mirror.open()
        mirror.go_to(ShellState.RUNNING)
        mirror.leave_set = leave_set
        steps: list[ShellState] = []
        step = mirror._step

        def record_step(state: ShellState, step=step, steps=steps) -> None:  # type: ignore[no-untyped-def]
            step(state)
            steps.append(state)

        with replace_hook(mirror, "_step", record_step):
            mirror.close()
        assert steps[-1:] == [last], f"close() with leave_set = {leave_set} went to {steps}"
