"""What an adaptive secondary promises beside what every mirror does: states, faults, positions."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import numpy as np

from escape_hw.api.adaptive_secondary import LADDER, AdaptiveSecondary, ShellHealth, ShellState
from escape_hw.errors import DeviceError
from escape_hw.testing.checks import (
    NORMAL,
    READS,
    TINY,
    Check,
    Factory,
    check,
    opened,
    refused,
    replaced,
    up_to,
)
from escape_hw.testing.mirror import MIRROR
from escape_hw.testing.mirror_tools import gentle


@contextmanager
def _faulty(mirror: AdaptiveSecondary) -> Iterator[None]:
    """Have the driver report a fault, as after a panic."""
    with ExitStack() as stack:
        for hook in ("_state", "_known_state"):
            stack.enter_context(replaced(mirror, hook, lambda: ShellState.FAULT))
        yield


@check(NORMAL)
def check_secondary_walks_the_ladder(factory: Factory) -> None:
    """``go`` leads to every state, up and down, and state and health agree on where it stands."""
    with opened(factory) as mirror:
        for state in (*reversed(LADDER), *LADDER):
            mirror.go(state)
            assert mirror.state is state, f"go({state}) ended in {mirror.state}"
            told = mirror.health.state
            assert told is state, f"in {state} the health says {told}"


@check(NORMAL)
def check_secondary_follows_commands_only_when_running(factory: Factory) -> None:
    """In any other state a command is refused, the shape stays, and ``flatten`` does nothing."""
    with opened(factory) as mirror:
        for state in LADDER[:-1]:
            mirror.go(state)
            shape, sent = mirror.shape, mirror.sent_count
            refused(mirror, DeviceError, f"a command while {state}", mirror.send, gentle(mirror))
            mirror.flatten()
            assert np.array_equal(mirror.shape, shape), f"a command while {state} changed the shape"
            assert mirror.sent_count == sent, f"a command while {state} was counted as sent"
        mirror.go(ShellState.RUNNING)
        mirror.send(gentle(mirror))


@check(NORMAL)
def check_secondary_is_flat_when_it_floats_anew(factory: Factory) -> None:
    """What was sent before a rest is forgotten, by the mirror and by the guard."""
    with opened(factory) as mirror:
        mirror.go(ShellState.RUNNING)
        mirror.send(gentle(mirror))
        mirror.go(ShellState.RESTED)
        mirror.go(ShellState.RUNNING)
        assert np.array_equal(mirror.shape, mirror.flat), "a shell that floats anew is not flat"


@check(READS)
def check_secondary_never_goes_to_a_fault(factory: Factory) -> None:
    """Nobody asks for a fault."""
    with opened(factory) as mirror:
        state = mirror.state
        try:
            mirror.go(ShellState.FAULT)
        except ValueError:
            assert mirror.state is state, "go(FAULT) was refused, but the state changed"
        else:
            raise AssertionError("go(FAULT) was let through")


@check(READS)
def check_secondary_measures_every_actuator(factory: Factory) -> None:
    """Positions are fractions of full stroke, one for each actuator, NaN where unreadable."""
    with opened(factory) as mirror:
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
def check_secondary_tells_its_health(factory: Factory) -> None:
    """Health is complete and finite, from the owner's seat as well as in passing."""
    with opened(factory) as mirror:
        for what, health in (("health", mirror.health), ("glance()", mirror.glance())):
            assert isinstance(health, ShellHealth), f"{what} is {type(health).__name__}"
            numbers = (health.gap_m, health.current_a, health.temperature_c)
            assert all(math.isfinite(n) for n in numbers), f"{what} holds {numbers}"
            assert 0 <= health.gap_m < 1e-3, f"{what}: a gap of {health.gap_m} m"
            assert health.skipped >= 0, f"{what}: {health.skipped} commands skipped"
            assert health.state is not ShellState.FAULT or health.fault, f"{what}: a fault without a reason"


@check(TINY)
def check_secondary_latches_faults(factory: Factory) -> None:
    """After a fault nothing moves it, closing does not either, and the errors say how to go on."""
    with opened(factory) as mirror:
        mirror.go(ShellState.RUNNING)
        shape = mirror.shape
        steps: list[ShellState] = []
        with _faulty(mirror), replaced(mirror, "_step", steps.append):
            for what, call in (
                ("a command", lambda: mirror.send(gentle(mirror))),
                ("going to running", lambda: mirror.go(ShellState.RUNNING)),
                ("going to rest", lambda: mirror.go(ShellState.RESTED)),
            ):
                refusal = refused(mirror, DeviceError, f"{what} with a fault latched", call)
                assert "recover" in str(refusal), f"{what}: the way out is not named: {refusal}"
            mirror.flatten()
            assert not steps, f"with a fault latched it went to {steps}"
            assert np.array_equal(mirror.shape, shape), "with a fault latched the shape changed"


@check(TINY)
def check_secondary_recovers_only_from_faults(factory: Factory) -> None:
    """``recover`` does nothing to a healthy mirror, and complains where the fault persists."""
    with opened(factory) as mirror:
        state = mirror.state
        asked: list[str] = []
        with replaced(mirror, "_recover", lambda: asked.append("recover")):
            mirror.recover()
            assert not asked, "recover() bothered a healthy mirror"
            with _faulty(mirror):
                refused(mirror, DeviceError, "recovery from a fault that persists", mirror.recover)
            assert asked, "recover() did not ask the mirror"
        assert mirror.state is state, f"recover() led a healthy mirror from {state} to {mirror.state}"


@check(NORMAL)
def check_secondary_rests_when_closed(factory: Factory) -> None:
    """Closing rests the shell, or leaves it set where that was asked for."""
    for leave_set, last in ((False, ShellState.RESTED), (True, ShellState.SET)):
        with opened(factory) as mirror:
            mirror.go(ShellState.RUNNING)
            mirror.leave_set = leave_set
            steps: list[ShellState] = []
            step = mirror._step  # noqa: SLF001 - what reaches the driver is what is checked

            def walking(state: ShellState, step=step, steps=steps) -> None:  # type: ignore[no-untyped-def]
                step(state)
                steps.append(state)

            with replaced(mirror, "_step", walking):
                mirror.close()
            assert steps[-1:] == [last], f"close() with leave_set = {leave_set} went to {steps}"


SECONDARY: tuple[Check, ...] = (
    *MIRROR,
    check_secondary_walks_the_ladder,
    check_secondary_follows_commands_only_when_running,
    check_secondary_is_flat_when_it_floats_anew,
    check_secondary_never_goes_to_a_fault,
    check_secondary_measures_every_actuator,
    check_secondary_tells_its_health,
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
    return up_to(SECONDARY, max_level)
