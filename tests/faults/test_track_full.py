"""Alarms of the tracker on the whole bench: 97 actuators, 24 lenslets across, full turbulence."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.tracking.tracker import track
from escape_hw.runtime.session.system import open_system

pytestmark = [pytest.mark.campaign, pytest.mark.timeout(1800)]

#: Seconds of tracking after which something happens.
AT = 6
#: An actuator well inside the pupil.
DEAD = 40


@pytest.fixture(scope="module")
def start():
    """A calibration to track from."""
    with open_system("razor-shwfs", seed=5) as bench:
        return bench.calibrate(frames=1000)


def followed(start, do, response=None, seconds=AT + 4):
    """Track with the usual pokes, and do something to the twin once some seconds have passed."""
    waiting = [do]
    with open_system("razor-shwfs", seed=5) as bench:
        twin = bench.dm.twin

        def watch(progress):
            if progress.stage == "tracking" and progress.done >= AT and waiting:
                waiting.pop()(twin)

        procedure = track(
            bench, start.matrix, start.grid, seconds=seconds, registration=start.registration,
            response=response or start.response,
        )  # fmt: skip
        found = bench.run(procedure, observers=(watch,))
        assert not bench.dm.shape.any()
    return found


def commands(change):
    """Something that happens to every command on its way to the mirror."""

    def happen(twin):
        send = twin.dynamics.command
        twin.dynamics.command = lambda time_s, shape: send(time_s, change(shape))

    return happen


def weaken(gain):
    """Leave one actuator with this share of its gain."""

    def change(shape):
        left = shape.copy()
        left[DEAD] *= gain
        return left

    return commands(change)


@pytest.mark.parametrize("gain", [0.0, 0.15])
def test_a_failed_actuator_is_named_and_nothing_exchanged_for_it(start, gain):
    # Pokes this small name it when half of the memory's frames are from after its failure.
    found = followed(start, weaken(gain), seconds=AT + 8)
    assert [alarm.kind for alarm in found.alarms] == ["actuator"]
    alarm = found.alarms[0]
    assert alarm.text.startswith(f"actuator {DEAD} ")
    assert AT < alarm.seconds <= AT + 7
    assert not [one for one in found.exchanges if one.accepted and one.seconds > AT + 1]
    apart = found.column("shift_x")[-1] - start.registration.registration.shift_x
    assert abs(apart) < 2.0


def test_a_loop_that_runs_away_is_opened(start):
    found = followed(start, commands(np.negative))
    assert not found.stable
    assert found.alarms[-1].kind == "diverged"
    assert found.alarms[-1].seconds < AT + 3.5


def test_a_wrong_delay_is_told_and_the_registration_kept(start):
    late = TemporalResponse(np.roll(start.response.weights, 1), start.response.sigma)
    found = followed(start, lambda twin: None, response=late, seconds=5)
    alarms = [alarm for alarm in found.alarms if alarm.kind == "delay"]
    assert len(alarms) == 1
    assert found.latest.response.delay_frames == pytest.approx(start.response.delay_frames, abs=0.1)
    apart = found.column("shift_x")[-1] - start.registration.registration.shift_x
    assert abs(apart) < 4 * found.column("shift_x_sigma")[-1]
