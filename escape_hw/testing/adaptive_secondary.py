"""What an adaptive secondary promises beside what every mirror does: states, faults, positions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from escape_hw.api.adaptive_secondary import STATE_ORDER, AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.errors import DeviceError
from escape_hw.testing.checks import (
    NORMAL,
    READS,
    TINY,
    Check,
    Factory,
    assert_refused,
    check,
    checks_up_to,
    open_device,
    replace_hook,
)
from escape_hw.testing.mirror import MIRROR_CHECKS, small_poke


@contextmanager
def _reporting_fault(mirror: AdaptiveSecondary) -> Iterator[None]:
    """Have the driver report a fault, as after a panic."""
    with ExitStack() as stack:
        for hook in ("_state", "_known_state"):
            stack.enter_context(replace_hook(mirror, hook, lambda: ShellState.FAULT))
        yield


@check(NORMAL)
def check_secondary_reaches_every_state(factory: Factory) -> None:
    """``go_to`` leads to every state, up and down, and state and health agree on where it stands."""
    with open_device(factory) as mirror:
        for state in (*reversed(STATE_ORDER), *STATE_ORDER):
            mirror.go_to(state)
            assert mirror.state is state, f"go({state}) ended in {mirror.state}"
            reported = mirror.health.state
            assert reported is state, f"in {state} the health says {reported}"


@check(NORMAL)
def check_secondary_follows_commands_only_when_running(factory: Factory) -> None:
    """In any other state a command is refused, the shape stays, and ``flatten`` does nothing."""
    with open_device(factory) as mirror:
        for state in STATE_ORDER[:-1]:
            mirror.go_to(state)
            shape, sent = mirror.shape, mirror.sent_count
            assert_refused(mirror, DeviceError, f"a command while {state}", mirror.send, small_poke(mirror))
            mirror.flatten()
            assert np.array_equal(mirror.shape, shape), f"a command while {state} changed the shape"
            assert mirror.sent_count == sent, f"a command while {state} was counted as sent"
        mirror.go_to(ShellState.RUNNING)
        mirror.send(small_poke(mirror))


@check(NORMAL)
def check_secondary_is_flat_after_rest(factory: Factory) -> None:
    """What was sent before a rest is forgotten, by the mirror and by the guard."""
    with open_device(factory) as mirror:
        mirror.go_to(ShellState.RUNNING)
        mirror.send(small_poke(mirror))
        mirror.go_to(ShellState.RESTED)
        mirror.go_to(ShellState.RUNNING)
        assert np.array_equal(mirror.shape, mirror.flat), "a shell that floats anew is not flat"


@check(READS)
def check_secondary_refuses_fault_as_target(factory: Factory) -> None:
    """Nobody asks for a fault."""
    with open_device(factory) as mirror:
        state = mirror.state
        try:
            mirror.go_to(ShellState.FAULT)
        except ValueError:
            assert mirror.state is state, "go(FAULT) was refused, but the state changed"
        else:
            raise AssertionError("go(FAULT) was let through")


@check(READS)
def check_secondary_measures_every_actuator(factory: Factory) -> None:
    """Positions are fractions of full stroke, one for each actuator, NaN where unreadable."""
    with open_device(factory) as mirror:
        places = mirror.measured_positions()
        assert places.dtype == np.float64, f"positions are {places.dtype}, not float64"
        assert places.shape == (mirror.info.n_act,), f"positions have shape {places.shape}"
        assert not np.isinf(places).any(), "a position is infinite; NaN stands for what cannot be read"
        far = np.nanmax(np.abs(places), initial=0.0)
        assert far < 10, f"a position is {far:.3g} full strokes; are they in metres or microns?"
        places += 0.25
        again = mirror.measured_positions()
        assert not np.array_equal(again, places, equal_nan=True), "the mirror handed out its own array"


@check(READS)
def check_secondary_reports_health(factory: Factory) -> None:
    """Health is complete and finite, from the owner's seat as well as in passing."""
    with open_device(factory) as mirror:
        for what, health in (("health", mirror.health), ("glance()", mirror.observe_health())):
            assert isinstance(health, ShellHealth), f"{what} is {type(health).__name__}"
            numbers = (health.gap_m, health.current_a, health.temperature_c)
            assert all(math.isfinite(n) for n in numbers), f"{what} holds {numbers}"
            assert 0 <= health.gap_m < 1e-3, f"{what}: a gap of {health.gap_m} m"
            assert health.skipped >= 0, f"{what}: {health.skipped} commands skipped"
            assert health.state is not ShellState.FAULT or health.fault, f"{what}: a fault without a reason"


@check(TINY)
def check_secondary_latches_faults(factory: Factory) -> None:
    """After a fault nothing moves it, closing does not either, and the errors say how to go on."""
    with open_device(factory) as mirror:
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
                assert "recover" in str(refusal), f"{what}: the way out is not named: {refusal}"
            mirror.flatten()
            assert not steps, f"with a fault latched it went to {steps}"
            assert np.array_equal(mirror.shape, shape), "with a fault latched the shape changed"


@check(TINY)
def check_secondary_recovers_only_from_faults(factory: Factory) -> None:
    """``recover`` does nothing to a healthy mirror, and complains where the fault persists."""
    with open_device(factory) as mirror:
        state = mirror.state
        asked: list[str] = []
        with replace_hook(mirror, "_recover", lambda: asked.append("recover")):
            mirror.recover()
            assert not asked, "recover() bothered a healthy mirror"
            with _reporting_fault(mirror):
                assert_refused(mirror, DeviceError, "recovery from a fault that persists", mirror.recover)
            assert asked, "recover() did not ask the mirror"
        assert mirror.state is state, f"recover() led a healthy mirror from {state} to {mirror.state}"


@check(NORMAL)
def check_secondary_rests_when_closed(factory: Factory) -> None:
    """Closing rests the shell, or leaves it set where that was asked for."""
    for leave_set, last in ((False, ShellState.RESTED), (True, ShellState.SET)):
        with open_device(factory) as mirror:
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


SECONDARY_CHECKS: tuple[Check, ...] = (
    *MIRROR_CHECKS,
    check_secondary_reaches_every_state,
    check_secondary_follows_commands_only_when_running,
    check_secondary_is_flat_after_rest,
    check_secondary_refuses_fault_as_target,
    check_secondary_measures_every_actuator,
    check_secondary_reports_health,
    check_secondary_latches_faults,
    check_secondary_recovers_only_from_faults,
    check_secondary_rests_when_closed,
)


def secondary_checks(max_level: int = 3) -> list[Check]:
    """Checks for an :class:`~escape_hw.api.adaptive_secondary.AdaptiveSecondary`.

    Parameters
    ----------
    max_level
        Leave out what moves the mirror more: 0 rests, 1 pokes by a percent, 2 walks through the
        states, 3 uses the full range.
    """
    return checks_up_to(SECONDARY_CHECKS, max_level)
