"""Closing the loop for a while, from the request to the kept run."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from escape_hw.api.procedure import Procedure
from escape_hw.api.results import LoopResult
from escape_hw.errors import ConfigError
from escape_hw.runtime.matrix_task import MatrixTask
from escape_hw.runtime.task import Kept, given, refuse_simulated

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord
    from escape_hw.runtime.telemetry_tape import TelemetryTape


class LoopTask(MatrixTask):
    """A closed-loop run; see :class:`~escape_hw.runtime.task.Task`.

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
        self.overrides = given({"loop.gain": gain, "loop.leak": leak, "loop.dropped_modes": dropped_modes})
        self._frames, self._best, self._strehl, self._record = frames, best, strehl, record
        self._tape: TelemetryTape | None = None

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[LoopResult]:
        """Model PSF where the bench can take one, best gain when asked, then the loop itself."""
        from escape_hw.calibration.closed_loop import closed_loop
        from escape_hw.calibration.gain_search import best_gain
        from escape_hw.runtime.procedures import model_psf

        refuse_simulated(self.product, bench, self._force)
        matrix, grid = self.product.matrix, self.product.grid
        if self._record:
            from escape_hw.runtime.telemetry_tape import TelemetryTape

            self._tape = TelemetryTape(self._record, grid.n_slopes, bench.dm.info.n_act)
            bench.taps = self._tape.taps
        model = gain = None
        if self._strehl and bench.science is not None:
            model = yield from model_psf(bench)
        if self._best:
            gain, runs = yield from best_gain(bench, matrix, grid, model_psf=model)
            stopped = [run for run in runs if run.partial]
            if stopped:
                return stopped[-1]
        return (yield from closed_loop(bench, matrix, grid, gain=gain, frames=self._frames, model_psf=model))

    def keep(self, folder: RunFolder, record: BenchRecord, result: LoopResult, wall_seconds: float) -> Kept:
        """See :meth:`~escape_hw.runtime.task.Task.keep`."""
        from escape_hw.io.documents import loop_document
        from escape_hw.report.tables import METHOD_LABELS
        from escape_hw.runtime import criteria
        from escape_hw.runtime.keep import finish, keep_loop, keep_telemetry

        label = METHOD_LABELS.get(result.method, result.method)
        if self._tape is not None:
            keep_telemetry(folder, record, "telemetry", self._tape.telemetry(), self.product.path)
        keep_loop(folder, record, "loop", result, self.product.path)
        document = finish(
            folder,
            {
                **record.head("loop"),
                "title": f"Closed loop on {record.system}",
                **loop_document(result),
                "im": self.product.path.absolute(),
                "criteria": [] if result.partial else criteria.loops({label: result}),
                "labels": {"loop": {"label": label}},
                **record.tail(wall_seconds),
            },
        )
        return Kept(document, result.stable)
