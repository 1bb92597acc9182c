"""The bootstrap stopped while it runs: mirror flat, measured data kept, and they can be saved."""

from __future__ import annotations

import threading

import pytest
from small_bench import assert_flat

from escape_hw.api.procedure import Progress
from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
from escape_hw.errors import Aborted
from escape_hw.io.fits.gains import load_gains, save_gains


class StopAt:
    """Sets ``abort`` in a stage, after so many of its frames."""

    def __init__(self, stage: str, frames: int) -> None:
        self.abort, self._stage, self._frames = threading.Event(), stage, frames

    def __call__(self, progress: Progress) -> None:
        if progress.stage.startswith(self._stage) and progress.done >= self._frames:
            self.abort.set()


@pytest.mark.parametrize(
    ("stage", "frames", "rounds"),
    [
        ("open loop", 50, 0),
        ("first closure", 10, 0),
        pytest.param("round 2", 700, 2, marks=pytest.mark.slow),
    ],
)
def test_stopped(bench, good, tmp_path, stage, frames, rounds):
    stop = StopAt(stage, frames)
    with pytest.raises(Aborted) as caught:
        bench.run(
            bootstrap_gains(bench, good.run.result, accuracy=0.001, frames=1200),
            observers=(stop,),
            abort=stop.abort,
        )
    assert_flat(bench)
    run = caught.value.partial
    assert run.result.partial
    assert not run.result.converged
    assert len(run.result.rounds) == rounds
    assert run.rescaled_calibration.partial == bool(rounds)
    path = save_gains(tmp_path / "gains.fits", run.result, "razor-shwfs", True)
    assert path.name == "gains.partial.fits"
    found = load_gains(path).result
    assert len(found.rounds) == rounds
    assert len(found.closure) == len(run.result.closure)
