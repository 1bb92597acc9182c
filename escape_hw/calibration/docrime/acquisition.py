"""Open-loop acquisition of pokes and slopes for DO-CRIME, with sensor set-up on the first frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Frame
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.sensor import SensorGeometry, SlopeFunction, SubApertureGrid
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import FluxMonitor, limit_to_reachable, next_frame
from escape_hw.calibration.acquisition.preview import MatrixEstimate, MatrixPreview, correlate_pokes
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
class SensorRun:
    """What depends on the geometry of the sensor, and accumulates the frames of a run.

    ``mean_frame (rows, columns)`` is the one that the geometry was found on; ``None`` if it was given.
    """

    grid: SensorGeometry
    mean_frame: NDArray[np.float32] | None
    slopes_of: SlopeFunction
    statistics: SlopeStatistics
    flux_monitor: FluxMonitor
    focus: StaticFocusEstimator | None
    estimator: DocrimeEstimator | None


class OpenLoopAcquisition:
    """State of an open-loop run; frames are buffered until the geometry is known.

    Parameters
    ----------
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

    def __init__(
        self,
        bench: Bench,
        m2c: NDArray[np.float64],
        grid: SensorGeometry | None,
        setup_frames: int,
        estimator_factory: Callable[[int], DocrimeEstimator] | None,
        *,
        store_samples: bool = False,
        monitor: RunMonitor | None = None,
    ) -> None:
        self.bench, self.m2c, self._setup_frames = bench, m2c, setup_frames
        self._estimator_factory, self._store_samples, self._monitor = (
            estimator_factory,
            store_samples,
            monitor,
        )
        self._grid = grid
        self._sensor: SensorRun | None = None
        self._pending_frames: list[tuple[Frame, NDArray[np.float64]]] = []
        self._partial_means: dict[int, tuple[NDArray[np.float64], int]] = {}
        self._recorded: list[tuple[int, NDArray[np.float32], NDArray[np.float64]]] = []
        self.n_received = self._n_processed = self._n_planned = self.shortened = 0
        self.uses_run_mean = get_sensor_kind(bench).uses_run_mean

    @property
    def sensor(self) -> SensorRun:
        """The sensor, set up on the frames so far; raises :class:`Aborted` if there are none."""
        self._process_pending()
        if self._sensor is None:
            raise Aborted("aborted before the first frames")
        return self._sensor

    def poke(self, frames: int, pokes: PokeSource, stage: str = "DO-CRIME") -> Procedure[bool]:
        """Send one poke per frame and process the frames; the mirror is flat in the end.

        ``frames``: number of frames, including those of a resumed run; ``pokes``: source of the modal poke of
        each frame ``(n_modes,)``.

        Returns whether the run was aborted; false if it ended by its stopping criterion.
        """
        bench, to_modes = self.bench, np.linalg.pinv(self.m2c)
        self._n_planned = frames
        report, preview = Reporter(stage, frames), MatrixPreview(self.m2c.shape[1], lambda: self.sensor.grid)
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
                    is_due = self._monitor is not None and self._monitor.is_due(self._n_processed)
                    if is_due and (yield from self._check_progress()):
                        return False
                    if report.is_due():
                        yield report(
                            done + 1, self._preview_arrays(preview), clipped_pokes=float(self.shortened)
                        )
            except Aborted:
                yield from self._check_progress(final=True)
                return True
        finally:
            bench.dm.flatten()
        return False

    def _preview_arrays(self, preview: MatrixPreview) -> Mapping[str, NDArray[np.float32]] | None:
        if self._sensor is None or not preview.is_due():
            return None
        estimator = self._sensor.estimator
        return preview(self._correlate_record if estimator is None else estimator.preview)

    def _correlate_record(self) -> MatrixEstimate:
        """Estimate for display in a run that is too short for a matrix."""
        record = self.record()
        return None if record is None else correlate_pokes(record[1], record[2])

    def _check_progress(self, final: bool = False) -> Procedure[bool]:
        """Save the state and evaluate the criterion, if due; whether the criterion is met."""
        sensor = self._sensor
        if self._monitor is None or sensor is None or sensor.estimator is None:
            return False
        values = {
            "taken": self.n_received,
            "fed": self._n_processed,
            "shortened": self.shortened,
            "looked": {str(part): count for part, (_, count) in self._partial_means.items()},
        }
        arrays: dict[str, NDArray[Any]] = {"motion": sensor.statistics.state()}
        if sensor.mean_frame is not None:
            arrays["mean_frame"] = sensor.mean_frame
        if sensor.focus is not None:
            arrays["focus"] = sensor.focus.state()
        arrays |= {f"looked.{part}": total for part, (total, _) in self._partial_means.items()}
        grid = sensor.statistics.annotate_geometry(sensor.grid)
        return (
            yield from self._monitor.check(
                sensor.estimator, grid, self._n_processed, values, arrays, final=final
            )
        )

    def restore(self, state: RunState) -> None:
        """Continue from a saved state; a pyramid is modulated first, for which its geometry was measured."""
        if state.grid is None:
            raise RuntimeError("a state without a geometry was saved")
        prepare_sensor(self.bench)
        sensor = self._sensor = self._set_up_sensor(state.grid, state.arrays.get("mean_frame"))
        self.n_received, self._n_processed = int(state.values["taken"]), int(state.values["fed"])
        self.shortened = int(state.values["shortened"])
        sensor.statistics.restore(state.arrays["motion"])
        if sensor.focus is not None and "focus" in state.arrays:
            sensor.focus.restore(state.arrays["focus"])
        self._partial_means = {
            int(part): (state.arrays[f"looked.{part}"], int(count))
            for part, count in state.values["looked"].items()
        }
        if sensor.estimator is not None:
            sensor.estimator.restore(state.values, state.arrays)

    def _handle_frame(self, frame: Frame, poke: NDArray[np.float64]) -> None:
        self.n_received += 1
        if self._sensor is not None:
            self._process_frame(self._sensor, frame, poke)
            return
        self._pending_frames.append((frame, poke))
        if self._grid is not None or len(self._pending_frames) >= self._setup_frames:
            self._process_pending()

    def _process_pending(self) -> None:
        """Set up the sensor, on the buffered frames if no geometry was given, and process these frames."""
        if self._sensor is not None or not self._pending_frames:
            return
        if self._grid is None:
            total = np.zeros(self._pending_frames[0][0].data.shape)
            for frame, _ in self._pending_frames:
                total += frame.data
            mean = (total / len(self._pending_frames)).astype(np.float32)
            setup = build_sensor_setup(self.bench, mean, frame=self._pending_frames[-1][0].data)
            self._sensor = self._set_up_sensor(setup.grid, setup.mean_frame)
        else:
            self._sensor = self._set_up_sensor(self._grid, None)
        for frame, poke in self._pending_frames:
            self._process_frame(self._sensor, frame, poke)
        self._pending_frames = []

    def _set_up_sensor(self, grid: SensorGeometry, mean_frame: NDArray[np.float32] | None) -> SensorRun:
        focus = None
        if mean_frame is not None and isinstance(grid, SubApertureGrid):
            focus = StaticFocusEstimator(grid, self.bench.wfs.settings.frame_rate_hz)
        return SensorRun(
            grid,
            mean_frame,
            build_slope_function(self.bench, grid),
            SlopeStatistics(grid.n_slopes),
            FluxMonitor(self.bench.wfs.name, grid),
            focus,
            None if self._estimator_factory is None else self._estimator_factory(grid.n_slopes),
        )

    def build_final_geometry(self) -> SensorGeometry:
        """The geometry improved by all frames of the run; references of a given geometry stay."""
        sensor = self.sensor
        grid = sensor.statistics.annotate_geometry(sensor.grid)
        if sensor.mean_frame is None:
            return grid
        if self._partial_means:
            means = [(total / count).astype(np.float32) for total, count in self._partial_means.values()]
            grid = refine_geometry(self.bench, grid, means)
        return sensor.statistics.update_references(grid, sensor.focus)

    def notes(self) -> tuple[str, ...]:
        """Notes on the accuracy of the references."""
        sensor, seconds = self.sensor, self.n_received / self.bench.wfs.settings.frame_rate_hz
        has_static_focus = sensor.focus is not None and sensor.focus.static_focus() is not None
        if sensor.mean_frame is None or seconds >= _MIN_REFERENCE_S or has_static_focus:
            return ()
        return (sensor.grid.short_run_note.format(seconds=seconds),)

    def _process_frame(self, sensor: SensorRun, frame: Frame, poke: NDArray[np.float64]) -> None:
        slopes = sensor.slopes_of(frame.data)
        sensor.flux_monitor(sensor.slopes_of.flux)
        sensor.statistics.add(slopes, poke)
        if sensor.focus is not None:
            sensor.focus.add(slopes)
        if self.uses_run_mean:
            self._add_to_partial_mean(frame)
        self._n_processed += 1
        if sensor.estimator is not None:
            sensor.estimator.partial_fit(frame.index, slopes, poke)
        if self._store_samples:
            self._recorded.append((frame.index, slopes, poke))

    def _add_to_partial_mean(self, frame: Frame) -> None:
        """Add a frame to the sum over its part of the run."""
        part = min(self._n_processed * _N_PARTS // max(self._n_planned, 1), _N_PARTS - 1)
        if part not in self._partial_means:
            self._partial_means[part] = frame.data.astype(np.float64), 1
            return
        total, count = self._partial_means[part]
        total += frame.data
        self._partial_means[part] = total, count + 1

    def record(self) -> AcquisitionRecord | None:
        """Frame indices, slopes and pokes; ``None`` if they were not stored."""
        if not self._recorded:
            return None
        index, slopes, pokes = zip(*self._recorded, strict=True)
        return np.array(index, np.int64), np.stack(slopes), np.stack(pokes).astype(np.float32)
