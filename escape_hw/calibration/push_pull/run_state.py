"""A measurement that goes on from one mode, or batch of modes, to the next."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Reporter
from escape_hw.api.sensor import SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import FluxMonitor, SlopeStatistics
from escape_hw.io.fits.run_state import RunState

#: Times that a step is repeated at most, to reach a signal-to-noise ratio.
MAX_ROUNDS = 16


class ModeByModeRun:
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
        checkpoint: Checkpoint | None,
    ) -> None:
        self.bench, self.slopes_of, self.report, self.mean_frame = bench, slopes_of, report, mean_frame
        self.slope_statistics = SlopeStatistics(slopes_of.grid.n_slopes)
        self.flux_monitor = FluxMonitor(bench.wfs.name, slopes_of.grid)
        self._checkpoint, self._start_status, self._resumed_counts = checkpoint, bench.wfs.status(), (0, 0)

    def restore(self, state: RunState) -> None:
        """Go on from a kept state."""
        self.mean_frame = state.arrays.get("mean_frame", self.mean_frame)
        self.slope_statistics.restore(state.arrays["motion"])
        self._resumed_counts = int(state.values["delivered"]), int(state.values["lost"])

    def count_frames(self) -> tuple[int, int]:
        """Frames delivered and lost, those of the run it goes on with included."""
        now = self.bench.wfs.status()
        delivered, lost = now.delivered - self._start_status.delivered, now.lost - self._start_status.lost
        return self._resumed_counts[0] + delivered, self._resumed_counts[1] + lost

    def checkpoint(self, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], final: bool) -> None:
        """Keep the state if it is time, or in any case; ``values`` and ``arrays`` are the steps' own."""
        if self._checkpoint is None or not (final or self._checkpoint.due()):
            return
        delivered, lost = self.count_frames()
        common: dict[str, NDArray[Any]] = {"motion": self.slope_statistics.state()}
        if self.mean_frame is not None:
            common["mean_frame"] = self.mean_frame
        totals = {"delivered": delivered, "lost": lost}
        self._checkpoint.save({**values, **totals}, {**arrays, **common}, self.slopes_of.grid)
