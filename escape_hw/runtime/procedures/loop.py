"""Closed-loop run for a number of frames, with an optional telemetry recording."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.callbacks import Callbacks
from escape_hw.api.camera import Frame
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import LoopResult
from escape_hw.errors import ConfigError
from escape_hw.io.fits.telemetry import LoopTelemetry
from escape_hw.runtime.procedures.task import SavedRun, TaskWithMatrix, require_hardware_matrix, set_overrides

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


class LoopTelemetryRecorder:
    """Keeps slopes and commands of the newest frames; one that was not answered keeps the command before.

    Parameters
    ----------
    frames
        How many.
    n_slopes, n_act
        Sizes.
    """

    def __init__(self, frames: int, n_slopes: int, n_act: int) -> None:
        self._index = np.zeros(frames, np.int64)
        self._exposed_ns = np.zeros(frames, np.int64)
        self._slopes = np.zeros((frames, n_slopes), np.float32)
        self._commands = np.zeros((frames, n_act))
        self._rows, self._n_recorded, self._newest_ns = frames, 0, 0
        self._command_pending = False

    @property
    def callbacks(self) -> Callbacks:
        """What to set as the bench's taps before anything runs."""
        return Callbacks(frame=self._frame, slopes=self._frame_slopes, command=self._command)

    def _frame(self, frame: Frame) -> None:
        self._newest_ns = frame.exposed_ns

    def _frame_slopes(self, index: int, slopes: NDArray[np.float32]) -> None:
        if slopes.size != self._slopes.shape[1]:
            # A look at the sensor with another geometry is no part of the loop.
            return
        row, before = self._n_recorded % self._rows, (self._n_recorded - 1) % self._rows
        self._index[row], self._exposed_ns[row], self._slopes[row] = index, self._newest_ns, slopes
        self._commands[row] = self._commands[before]
        self._n_recorded += 1
        self._command_pending = True

    def _command(self, command: NDArray[np.float64]) -> None:
        # Only the first answers the frame: what comes without a frame between flattens the mirror.
        if self._command_pending:
            self._commands[(self._n_recorded - 1) % self._rows] = command
            self._command_pending = False

    def to_telemetry(self) -> LoopTelemetry:
        """A copy of what was recorded, oldest first, from the last start of the camera's numbers on."""
        n = min(self._n_recorded, self._rows)
        order = (np.arange(self._n_recorded - n, self._n_recorded)) % self._rows
        restarts = np.flatnonzero(np.diff(self._index[order]) <= 0)
        order = order[restarts[-1] + 1 :] if restarts.size else order
        exposed = self._exposed_ns[order]
        return LoopTelemetry(
            self._index[order],
            np.asarray((exposed - exposed[:1]) * 1e-9, np.float64),
            self._slopes[order],
            self._commands[order],
        )


class LoopTask(TaskWithMatrix):
    """A closed-loop run; see :class:`~escape_hw.runtime.procedures.task.Task`.

    Parameters
    ----------
    im
        File of the matrix.
    frames
        How long.
    gain, leak, dropped_modes
        Loop parameters; as configured by default.
    best
        Look for the best gain first.
    strehl
        Measure the model PSF and the Strehl ratios.
    record
        Keep slopes and commands of the newest so many frames.
    force
        Allow a simulated matrix on hardware.
    """

    kind = "loop"

    def __init__(
        self,
        im: Path,
        *,
        frames: int = 5000,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
        best: bool = False,
        strehl: bool = True,
        record: int = 0,
        force: bool = False,
    ) -> None:
        super().__init__(im, force=force)
        if best and gain is not None:
            raise ConfigError("--gain and --best-gain exclude each other")
        self.overrides = set_overrides(
            {"loop.gain": gain, "loop.leak": leak, "loop.dropped_modes": dropped_modes}
        )
        self._frames, self._search_gain, self._strehl, self._record = frames, best, strehl, record
        self._recorder: LoopTelemetryRecorder | None = None

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[LoopResult]:
        """Model PSF where the bench can take one, best gain when asked, then the loop itself."""
        from escape_hw.calibration.loop.gain_search import find_best_gain
        from escape_hw.calibration.loop.performance import close_loop
        from escape_hw.runtime.procedures.calibration import model_psf

        require_hardware_matrix(self.product, bench, self._force)
        matrix, grid = self.product.matrix, self.product.grid
        if self._record:
            self._recorder = LoopTelemetryRecorder(self._record, grid.n_slopes, bench.dm.info.n_act)
            bench.callbacks = self._recorder.callbacks
        model = gain = None
        gain_sigma = None
        if self._strehl and bench.science is not None:
            model = yield from model_psf(bench)
        if self._search_gain:
            search = yield from find_best_gain(bench, matrix, grid, model_psf=model)
            gain, gain_sigma = search.gain, search.sigma
            stopped = [run for run in search.runs if run.partial]
            if stopped:
                return stopped[-1]
        result = yield from close_loop(bench, matrix, grid, gain=gain, frames=self._frames, model_psf=model)
        return replace(result, gain_sigma=gain_sigma)

    def save(
        self, folder: RunFolder, record: BenchRecord, result: LoopResult, wall_seconds: float
    ) -> SavedRun:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.save`."""
        from escape_hw.io.documents import loop_document
        from escape_hw.report.tables import METHOD_LABELS
        from escape_hw.runtime.procedures import criteria
        from escape_hw.runtime.procedures.products import add_loop, add_telemetry, write_run_result

        label = METHOD_LABELS.get(result.method, result.method)
        if self._recorder is not None:
            add_telemetry(folder, record, "telemetry", self._recorder.to_telemetry(), self.product.path)
        add_loop(folder, record, "loop", result, self.product.path)
        document = write_run_result(
            folder,
            {
                **record.header_fields("loop"),
                "title": f"Closed loop on {record.system}",
                **loop_document(result),
                "im": self.product.path.absolute(),
                "criteria": [] if result.partial else criteria.loop_criteria({label: result}),
                "labels": {"loop": {"label": label}},
                **record.footer_fields(wall_seconds),
            },
        )
        return SavedRun(document, result.stable)
