"""A measurement that goes on from one mode, or batch of modes, to the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Reporter
from escape_hw.api.sensor import SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import LightWatch, Motion
from escape_hw.calibration.checkpoint import Checkpoint
from escape_hw.io.state_file import RunState

#: Times that a step is repeated at most, to reach a signal-to-noise ratio.
ROUNDS = 16


class StepwiseRun:
    """What the steps so far amount to, beside their results.

    Parameters
    ----------
    bench, slopes_of
        The bench and its slopes.
    report
        Counts the frames for the progress.
    mean_frame
        What the geometry was found on; ``None`` if it was known.
    keep
        Where the state goes.

    Attributes
    ----------
    motion, light
        Watch the slopes and the light of all frames.
    """

    def __init__(
        self,
        bench: Bench,
        slopes_of: SlopeFunction,
        report: Reporter,
        mean_frame: NDArray[np.float32] | None,
        keep: Checkpoint | None,
    ) -> None:
        self.bench, self.slopes_of, self.report, self.mean_frame = bench, slopes_of, report, mean_frame
        self.motion = Motion(slopes_of.grid.n_slopes)
        self.light = LightWatch(bench.wfs.name, slopes_of.grid)
        self._keep, self._start, self._before = keep, bench.wfs.status(), (0, 0)

    def restore(self, state: RunState) -> None:
        """Go on from a kept state."""
        self.mean_frame = state.arrays.get("mean_frame", self.mean_frame)
        self.motion.restore(state.arrays["motion"])
        self._before = int(state.values["delivered"]), int(state.values["lost"])

    def counts(self) -> tuple[int, int]:
        """Frames delivered and lost, those of the run it goes on with included."""
        now = self.bench.wfs.status()
        delivered, lost = now.delivered - self._start.delivered, now.lost - self._start.lost
        return self._before[0] + delivered, self._before[1] + lost

    def keep(self, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], always: bool) -> None:
        """Keep the state if it is time, or in any case; ``values`` and ``arrays`` are the steps' own."""
        if self._keep is None or not (always or self._keep.due()):
            return
        delivered, lost = self.counts()
        common: dict[str, NDArray[Any]] = {"motion": self.motion.state()}
        if self.mean_frame is not None:
            common["mean_frame"] = self.mean_frame
        counts = {"delivered": delivered, "lost": lost}
        self._keep.save({**values, **counts}, {**arrays, **common}, self.slopes_of.grid)
