"""Open-loop acquisition of pokes and slopes for DO-CRIME, with sensor set-up on the first frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Frame
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.sensor import SensorGeometry, SlopeFunction, SubApertureGrid
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import FluxMonitor, limit_to_reachable, next_frame
from escape_hw.calibration.acquisition.preview import MatrixPreview
from escape_hw.calibration.acquisition.sensor_setup import (
    build_sensor_setup,
    build_slope_function,
    get_sensor_kind,
    prepare_sensor,
    refine_geometry,
)
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics, StaticFocusEstimator
from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.calibration.docrime.monitor import RunMonitor
from escape_hw.calibration.loop.runner import PokeSource
from escape_hw.errors import Aborted
from escape_hw.io.fits.run_state import RunState

#: Seconds of turbulence over which the mean slopes become accurate references.
_MIN_REFERENCE_S = 10.0
#: Parts of a run whose mean frames are compared.
_N_PARTS = 6

#: Frame indices ``(n,)``, slopes ``(n, n_slopes)`` and pokes ``(n, n_modes)``.
AcquisitionRecord = tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]


@dataclass(slots=True, eq=False)
class OpenLoopAcquisition:
    """State of an open-loop run; frames are buffered until the geometry is known.

    Parameters
    ----------
    bench
        An open bench, loop open.
    m2c
        Mode-to-command matrix ``(n_act, n_modes)``.
    grid
        Geometry of the sensor, if it is known; otherwise it is found on the first frames.
    setup_frames
        Number of frames to find it on.
    estimator_factory
        Builds the estimator from the number of slopes; ``None``: no estimator.
    store_samples
        Whether to keep slopes and pokes, for :meth:`record`.
    monitor
        Checkpoint and stopping criterion of the estimate.
    """

    bench: Bench
    m2c: NDArray[np.float64]
    grid: SensorGeometry | None
    setup_frames: int
    estimator_factory: Callable[[int], DocrimeEstimator] | None
    store_samples: bool = False
    monitor: RunMonitor | None = None
    mean_frame: NDArray[np.float32] | None = None
    slopes_of: SlopeFunction | None = None
    estimator: DocrimeEstimator | None = None
    slope_statistics: SlopeStatistics | None = None
    focus_estimator: StaticFocusEstimator | None = None
    flux_monitor: FluxMonitor | None = None
    pending_frames: list[tuple[Frame, NDArray[np.float64]]] = field(default_factory=list)
    n_received: int = 0
    n_processed: int = 0
    shortened: int = 0
    n_planned: int = 0
    uses_run_mean: bool = False
    partial_means: dict[int, tuple[NDArray[np.float64], int]] = field(default_factory=dict)
    recorded: list[tuple[int, NDArray[np.float32], NDArray[np.float64]]] = field(default_factory=list)

    def poke(self, frames: int, pokes: PokeSource, stage: str = "DO-CRIME") -> Procedure[bool]:
        """Send one poke per frame and process the frames; the mirror is flat in the end.

        Parameters
        ----------
        frames
            Number of frames, including those of a resumed run.
        pokes
            Source of the modal poke of each frame ``(n_modes,)``.
        stage
            Name of the stage in progress reports.

        Returns
        -------
        bool
            Whether the run was aborted; false if it ended by its stopping criterion.
        """
        bench, to_modes = self.bench, np.linalg.pinv(self.m2c)
        self.n_planned = frames
        report, preview = Reporter(stage, frames), MatrixPreview(self.m2c.shape[1], lambda: self.grid)
        try:
            bench.dm.flatten()
            prepare_sensor(bench)
            try:
                for done in range(self.n_received, frames):
                    frame = next_frame(bench)
                    requested = self.m2c @ pokes()
                    achievable = limit_to_reachable(bench.dm, requested)
                    self.shortened += not np.array_equal(requested, achievable)
                    # The poke as sent: a shortened poke is a known poke, too.
                    self._handle_frame(frame, to_modes @ bench.dm.send(achievable).sent)
                    is_due = self.monitor is not None and self.monitor.is_due(self.n_processed)
                    if is_due and (yield from self._check_progress()):
                        return False
                    if report.is_due():
                        yield report(done + 1, self._preview_arrays(preview), shortened=float(self.shortened))
            except Aborted:
                yield from self._check_progress(final=True)
                return True
        finally:
            bench.dm.flatten()
        return False

    def _preview_arrays(self, preview: MatrixPreview) -> Mapping[str, NDArray[np.float32]] | None:
        if self.estimator is None or not preview.is_due():
            return None
        return preview(self.estimator.preview)

    def _check_progress(self, final: bool = False) -> Procedure[bool]:
        """Save the state and evaluate the criterion, if due; whether the criterion is met."""
        if (
            self.monitor is None
            or self.estimator is None
            or self.grid is None
            or self.slope_statistics is None
        ):
            return False
        grid = self.slope_statistics.annotate_geometry(self.grid)
        parts = {str(part): count for part, (_, count) in self.partial_means.items()}
        values = {
            "taken": self.n_received,
            "fed": self.n_processed,
            "shortened": self.shortened,
            "looked": parts,
        }
        arrays: dict[str, NDArray[Any]] = {"motion": self.slope_statistics.state()}
        if self.mean_frame is not None:
            arrays["mean_frame"] = self.mean_frame
        if self.focus_estimator is not None:
            arrays["focus"] = self.focus_estimator.state()
        arrays |= {f"looked.{part}": total for part, (total, _) in self.partial_means.items()}
        return (
            yield from self.monitor.check(self.estimator, grid, self.n_processed, values, arrays, final=final)
        )

    def restore(self, state: RunState) -> None:
        """Continue from a saved state."""
        if state.grid is None:
            raise RuntimeError("a state without a geometry was saved")
        self.grid = state.grid
        self.mean_frame = state.arrays.get("mean_frame")
        self._set_up_sensor()
        if self.slope_statistics is None or self.estimator is None:
            raise RuntimeError("the sensor was never set up")
        self.n_received, self.n_processed = int(state.values["taken"]), int(state.values["fed"])
        self.shortened = int(state.values["shortened"])
        self.slope_statistics.restore(state.arrays["motion"])
        if self.focus_estimator is not None and "focus" in state.arrays:
            self.focus_estimator.restore(state.arrays["focus"])
        self.partial_means = {
            int(part): (state.arrays[f"looked.{part}"], int(count))
            for part, count in state.values["looked"].items()
        }
        self.estimator.restore(state.values, state.arrays)

    def _handle_frame(self, frame: Frame, poke: NDArray[np.float64]) -> None:
        self.n_received += 1
        if self.slopes_of is None:
            self.pending_frames.append((frame, poke))
            if self.grid is not None or len(self.pending_frames) >= self.setup_frames:
                self.process_pending()
        else:
            self._process_frame(frame, poke)

    def process_pending(self) -> None:
        """Set up the sensor, on the buffered frames if no geometry was given, and process these frames."""
        if self.slopes_of is not None or not self.pending_frames:
            return
        if self.grid is None:
            total = np.zeros(self.pending_frames[0][0].data.shape)
            for frame, _ in self.pending_frames:
                total += frame.data
            mean = (total / len(self.pending_frames)).astype(np.float32)
            setup = build_sensor_setup(self.bench, mean)
            self.grid, self.mean_frame = setup.grid, setup.mean_frame
        self._set_up_sensor()
        for frame, poke in self.pending_frames:
            self._process_frame(frame, poke)
        self.pending_frames = []

    def _set_up_sensor(self) -> None:
        """Create everything that depends on the geometry."""
        if self.grid is None:
            raise RuntimeError("the geometry is not known")
        self.slopes_of = build_slope_function(self.bench, self.grid)
        self.uses_run_mean = get_sensor_kind(self.bench).uses_run_mean
        self.slope_statistics = SlopeStatistics(self.grid.n_slopes)
        self.flux_monitor = FluxMonitor(self.bench.wfs.name, self.grid)
        if self.mean_frame is not None and isinstance(self.grid, SubApertureGrid):
            self.focus_estimator = StaticFocusEstimator(self.grid, self.bench.wfs.settings.frame_rate_hz)
        if self.estimator_factory is not None:
            self.estimator = self.estimator_factory(self.grid.n_slopes)

    def build_final_geometry(self) -> SensorGeometry:
        """The geometry improved by all frames of the run; references of a given geometry stay."""
        if self.grid is None or self.slope_statistics is None:
            raise RuntimeError("the sensor was never set up")
        grid = self.slope_statistics.annotate_geometry(self.grid)
        if self.mean_frame is None:
            return grid
        if self.partial_means:
            means = [(total / count).astype(np.float32) for total, count in self.partial_means.values()]
            grid = refine_geometry(self.bench, grid, means)
        return self.slope_statistics.update_references(grid, self.focus_estimator)

    def notes(self) -> tuple[str, ...]:
        """Notes on the accuracy of the references."""
        seconds = self.n_received / self.bench.wfs.settings.frame_rate_hz
        has_static_focus = (
            self.focus_estimator is not None and self.focus_estimator.static_focus() is not None
        )
        if self.grid is None or self.mean_frame is None or seconds >= _MIN_REFERENCE_S or has_static_focus:
            return ()
        return (self.grid.short_run_note.format(seconds=seconds),)

    def _process_frame(self, frame: Frame, poke: NDArray[np.float64]) -> None:
        if self.slopes_of is None or self.slope_statistics is None or self.flux_monitor is None:
            raise RuntimeError("a frame was processed before the sensor was set up")
        slopes = self.slopes_of(frame.data)
        self.flux_monitor(self.slopes_of.flux)
        self.slope_statistics.add(slopes, poke)
        if self.focus_estimator is not None:
            self.focus_estimator.add(slopes)
        if self.uses_run_mean:
            self._add_to_partial_mean(frame)
        self.n_processed += 1
        if self.estimator is not None:
            self.estimator.partial_fit(frame.index, slopes, poke)
        if self.store_samples:
            self.recorded.append((frame.index, slopes, poke))

    def _add_to_partial_mean(self, frame: Frame) -> None:
        """Add a frame to the sum over its part of the run."""
        part = min(self.n_processed * _N_PARTS // max(self.n_planned, 1), _N_PARTS - 1)
        if part not in self.partial_means:
            self.partial_means[part] = frame.data.astype(np.float64), 1
            return
        total, count = self.partial_means[part]
        total += frame.data
        self.partial_means[part] = total, count + 1

    def record(self) -> AcquisitionRecord | None:
        """Frame indices, slopes and pokes; ``None`` if they were not stored."""
        if not self.recorded:
            return None
        index, slopes, pokes = zip(*self.recorded, strict=True)
        return np.array(index, np.int64), np.stack(slopes), np.stack(pokes).astype(np.float32)
