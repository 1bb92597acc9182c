"""Mirror statistics in the engine's state, independent of the publishing rate."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest

from escape_hw.server.engine.state_publisher import StatePublisher


class MirrorSequence:
    """A state publisher of a mirror with ten actuators and 500 commands per second, and a clock."""

    def __init__(self) -> None:
        self.now = 1000.0
        self.dm = SimpleNamespace(is_open=True, clipped_count=0, sent_count=0, flatten_count=0)
        bench: Any = SimpleNamespace(dm=self.dm)
        publisher: Any = SimpleNamespace(latest_command=np.full(10, 0.5))
        nothing: Any = None
        self.state_publisher = StatePublisher(
            bench, nothing, publisher, nothing, Path(), lambda state: None, clock=lambda: self.now
        )

    def advance(self, seconds: float, every: float, clipped: int) -> float:
        """Advance the time with some actuators clipped; returns the share in the last state."""
        share = 0.0
        for _ in range(round(seconds / every)):
            self.now += every
            self.dm.sent_count += round(500 * every)
            self.dm.clipped_count += clipped * round(500 * every)
            share = self.state_publisher._mirror().saturated_share
        return share


@pytest.mark.parametrize("every", [0.02, 0.2, 0.5, 2.0])
def test_the_share_of_clipped_actuators_is_that_of_the_last_second(every: float) -> None:
    sequence = MirrorSequence()
    sequence.advance(4, every, clipped=0)
    share = sequence.advance(max(every, 0.5), every, clipped=4)
    assert share == pytest.approx(0.4 if every > 1 else 0.2, abs=0.05)
    assert sequence.advance(2, every, clipped=4) == pytest.approx(0.4)


def test_the_number_of_flattenings_is_in_the_state() -> None:
    sequence = MirrorSequence()
    sequence.dm.flatten_count = 3
    assert sequence.state_publisher._mirror().flatten_count == 3


def test_a_run_that_does_not_read_the_sensor_loses_no_frames() -> None:
    """The model PSF: the sensor's camera goes on, and nobody reads it."""
    wfs = SimpleNamespace(is_open=True, status=lambda: SimpleNamespace(lost=wfs.lost), lost=0)
    bench, publisher, nothing = (
        cast(Any, one) for one in (SimpleNamespace(wfs=wfs), SimpleNamespace(), None)
    )
    state_publisher = StatePublisher(bench, nothing, publisher, nothing, Path(), lambda state: None)
    run: Any = SimpleNamespace(loop_control=None, active_run="model-psf")
    for frames, lost, shown in ((500, 2, 2), (500, 80, 2), (501, 81, 81)):
        publisher.frames, wfs.lost = frames, lost
        assert state_publisher._frame_counters(None, run).lost_frames == shown
