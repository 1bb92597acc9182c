"""Faults between driver and controller at every command: documented state, within the time-out, reported."""

from __future__ import annotations

import re
import time

import pytest
from pipe import TIMEOUT_S, Peers

from escape_hw.api.modulator import Modulation
from escape_hw.errors import DeviceError
from escape_sim.emulators.e727.transports import FAULT_KINDS, FaultInjector

CIRCLE = Modulation(1.41e-4, 303.03)
#: What a message tells the operator to do.
WAY_OUT = re.compile(r"open again|again|see |is the|start|park")
#: A call ends within three time-outs for each of the two things that it may have to give up, a fifth of a
#: second; and what a busy machine makes of it.
LONGEST_S = 180 * TIMEOUT_S


def session(peers: Peers) -> list[str]:
    """Open, turn, park, turn, close; what failed, as text."""
    failures = []
    stage = peers.driver()

    def step(call, *args):
        began = time.monotonic()
        try:
            result = call(*args)
        except DeviceError as error:
            failures.append(str(error))
            result = None
        assert time.monotonic() - began < LONGEST_S, f"{call} took {time.monotonic() - began:.1f} s"
        return result

    if step(stage.open) is not None:
        reached = step(stage.modulate, CIRCLE)
        if reached is not None:
            assert peers.condition == "turning"
        step(stage.park)
    step(stage.close)
    assert not stage.is_open
    for failure in failures:
        assert failure.startswith("stage: ")
        assert WAY_OUT.search(failure), f"does not say what to do: {failure}"
    return failures


def commands_of_a_session() -> int:
    peers = Peers()
    assert session(peers) == []
    assert peers.controller.state.violations == []
    return len(peers.controller.received_commands)


def check(kind: str, at: int) -> None:
    peers = Peers({at: kind})
    failures = session(peers)
    if kind in ("delay", "double", "garbage") or (
        kind in ("drop_reply", "truncate", "drop_command") and not failures
    ):
        assert peers.condition == "at rest", (kind, at, failures)
    # A session may need one command less than the one that was counted, when a wait ends earlier.
    happened = at < len(peers.controller.received_commands)
    if happened and kind in ("close", "reset", "power_cut", "stall"):
        assert failures, (kind, at, "a lost link must be told")
    if not happened:
        peers.wire = FaultInjector()
    # Whatever happened: the next opening finds everything in order, and leaves it at rest.
    peers.wire.is_stalled = False
    with peers.driver() as again:
        assert peers.condition == "servo on"
        again.modulate(CIRCLE)
        assert peers.condition == "turning"
    assert peers.condition == "at rest"


STRIDE = 12


@pytest.mark.parametrize("kind", FAULT_KINDS)
@pytest.mark.slow
def test_a_fault_now_and_then(kind: str) -> None:
    for at in range(FAULT_KINDS.index(kind) % STRIDE, commands_of_a_session(), STRIDE):
        check(kind, at)


@pytest.mark.slow
@pytest.mark.parametrize("kind", FAULT_KINDS)
def test_a_fault_at_every_command(kind: str) -> None:
    for at in range(commands_of_a_session()):
        check(kind, at)
