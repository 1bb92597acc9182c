"""How long an engine may be silent: briefly while something may move the mirror, longer while it is idle."""

from __future__ import annotations

import pytest

from escape_hw.config.system import ServerSection
from escape_hw.remote.state import ActiveRun, LoopState, MirrorState, State
from escape_hw.server.frontend.engine_supervisor import IDLE_SILENCE_LIMIT_S, silence_limit_s

LIMITS = ServerSection(engine_silence_s=3.0)
PID = 71
IDLE = State(engine_pid=PID)
MOVING = [
    {"mirror": MirrorState(peak=0.01)},
    {"loop": LoopState(closed=True)},
    # The mirror may have left its flat since the last state of a run.
    {"active_run": ActiveRun(id=1, name="docrime", arguments={})},
]


def test_an_idle_engine_may_be_silent_for_long():
    assert silence_limit_s(IDLE, PID, LIMITS) == IDLE_SILENCE_LIMIT_S


@pytest.mark.parametrize("changes", MOVING, ids=["shape", "loop", "run"])
def test_an_engine_that_may_move_the_mirror_is_ended_soon(changes):
    assert silence_limit_s(IDLE.model_copy(update=changes), PID, LIMITS) == 3.0


@pytest.mark.parametrize("changes", MOVING, ids=["shape", "loop", "run"])
def test_an_engine_that_starts_is_not_judged_by_the_state_of_the_one_before(changes):
    for before in (0, PID + 1):
        last = IDLE.model_copy(update={**changes, "engine_pid": before})
        assert silence_limit_s(last, PID, LIMITS) == IDLE_SILENCE_LIMIT_S
