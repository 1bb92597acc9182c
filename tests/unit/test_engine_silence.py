"""How long an engine may be silent: briefly while something may move the mirror, longer while it is idle."""

from __future__ import annotations

import pytest

from escape_hw.config.system import ServerSection
from escape_hw.remote.state import ActiveRun, LoopState, MirrorState, State
from escape_hw.server.frontend.engine_supervisor import IDLE_SILENCE_LIMIT_S, silence_limit_s

LIMITS = ServerSection(engine_silence_s=3.0)
IDLE = State()


def test_an_idle_engine_may_be_silent_for_long():
    assert silence_limit_s(IDLE, LIMITS) == IDLE_SILENCE_LIMIT_S


@pytest.mark.parametrize(
    "changes",
    [
        {"mirror": MirrorState(peak=0.01)},
        {"loop": LoopState(closed=True)},
        # The mirror may have left its flat since the last state of a run.
        {"active_run": ActiveRun(id=1, name="docrime", arguments={})},
    ],
    ids=["shape", "loop", "run"],
)
def test_an_engine_that_may_move_the_mirror_is_ended_soon(changes):
    assert silence_limit_s(IDLE.model_copy(update=changes), LIMITS) == 3.0
