"""State of a measurement that proceeds mode by mode, or batch by batch of modes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Reporter
from escape_hw.api.sensor import SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import FluxMonitor
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics
from escape_hw.io.fits.run_state import RunState

#: Largest number of repetitions of a step, to reach a signal-to-noise ratio.
MAX_ROUNDS = 16


class ModeByModeRun:
    """State that all measurements mode by mode share: slope statistics, frame counts, checkpoint.

    Parameters
    ----------
    bench, slopes_of
        Bench and slope function.
    report
        Progress reporter, which counts frames.
    mean_frame
        Mean frame that the geometry was found on; ``None`` if the geometry was given.
    checkpoint
        Where the state is saved; ``None``: it is not saved.

    Attributes
    ----------
    slope_statistics, flux_monitor
        Statistics of the slopes and flux check of all frames.
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
        """Continue from a saved state."""
        self.mean_frame = state.arrays.get("mean_frame", self.mean_frame)
        self.slope_statistics.restore(state.arrays["motion"])
        self._resumed_counts = int(state.values["delivered"]), int(state.values["lost"])

    def count_frames(self) -> tuple[int, int]:
        """Number of frames delivered and lost, including those of a resumed run."""
        now = self.bench.wfs.status()
        delivered, lost = now.delivered - self._start_status.delivered, now.lost - self._start_status.lost
        return self._resumed_counts[0] + delivered, self._resumed_counts[1] + lost

    def checkpoint(self, values: Mapping[str, Any], arrays: Mapping[str, NDArray[Any]], final: bool) -> None:
        """Save the state with these further entries, if it is time or this is the ``final`` state."""
        if self._checkpoint is None or not (final or self._checkpoint.is_due()):
            return
        delivered, lost = self.count_frames()
        common: dict[str, NDArray[Any]] = {"motion": self.slope_statistics.state()}
        if self.mean_frame is not None:
            common["mean_frame"] = self.mean_frame
        totals = {"delivered": delivered, "lost": lost}
        self._checkpoint.save({**values, **totals}, {**arrays, **common}, self.slopes_of.grid)
