"""Closed-loop run for a number of frames, with an optional telemetry recording."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

from escape_hw.errors import ConfigError
from escape_hw.runtime.procedures.declaration import SavedRun, parameter
from escape_hw.runtime.procedures.matrix_input import MatrixProcedure, require_hardware_matrix

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.api.results import LoopResult
    from escape_hw.bench import Bench
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.procedures.loop_telemetry import LoopTelemetryRecorder
    from escape_hw.runtime.session.record import BenchRecord


class LoopProcedure(MatrixProcedure["LoopResult"]):
    """A closed loop for a number of frames, with its performance and, if wanted, its telemetry."""

    name = "loop"
    title = "Closed loop"
    help = "Close the loop with an interaction matrix for a number of frames and measure its performance."

    frames: int = parameter(default=5000, help="Frames to run.", unit="frame", low=1, high=1e8)
    gain: float | None = parameter(
        default=None, help="Gain of the integrator.", low=0.001, high=2, config_key="loop.gain",
        sets_config=True,
    )  # fmt: skip
    leak: float | None = parameter(
        default=None, help="Leak of the integrator per frame.", low=0, high=1, config_key="loop.leak",
        sets_config=True,
    )  # fmt: skip
    dropped_modes: int | None = parameter(
        default=None, help="Weakest eigenmodes left out of the reconstructor.", low=0, high=10000,
        config_key="loop.dropped_modes", sets_config=True, deprecated=("drop",),
    )  # fmt: skip
    best_gain: bool = parameter(
        default=False, help="Search for the gain with the best performance first.", label="Optimise gain",
        deprecated=("best",),
    )  # fmt: skip
    record: int = parameter(
        default=0, help="Save slopes and commands of the last frames, this many.", unit="frame", low=0,
        on_server=False,
    )  # fmt: skip

    def __post_init__(self) -> None:
        super().__post_init__()
        self._recorder: LoopTelemetryRecorder | None = None

    def validate(self) -> None:
        """Refuse a gain together with a search for it."""
        if self.best_gain and self.gain is not None:
            raise ConfigError("gain and best_gain exclude each other (options --gain and --best-gain)")

    def procedure(self, bench: Bench, folder: RunFolder | None) -> Procedure[LoopResult]:
        """Measure the model PSF, search for the best gain if wanted, then close the loop."""
        from escape_hw.calibration.loop.gain_search import find_best_gain
        from escape_hw.calibration.loop.performance import close_loop

        require_hardware_matrix(self.product, bench, self.force)
        matrix, grid = self.product.matrix, self.product.grid
        if self.record:
            from escape_hw.runtime.procedures.loop_telemetry import LoopTelemetryRecorder

            self._recorder = LoopTelemetryRecorder(self.record, grid.n_slopes, bench.dm.info.n_act)
            bench.callbacks = self._recorder.callbacks
        model = yield from self.take_model_psf(bench)
        gain = gain_sigma = None
        if self.best_gain:
            search = yield from find_best_gain(bench, matrix, grid, model_psf=model)
            gain, gain_sigma = search.gain, search.sigma
            stopped = [run for run in search.runs if run.partial]
            if stopped:
                return stopped[-1]
        result = yield from close_loop(bench, matrix, grid, gain=gain, frames=self.frames, model_psf=model)
        return replace(result, gain_sigma=gain_sigma)

    def save(
        self, folder: RunFolder, record: BenchRecord, result: LoopResult, wall_seconds: float
    ) -> SavedRun:
        """Save performance, telemetry and report."""
        from escape_hw.io.documents import loop_document
        from escape_hw.report.tables import METHOD_LABELS
        from escape_hw.runtime.procedures import criteria
        from escape_hw.runtime.procedures.products import add_result, save_run

        label = METHOD_LABELS.get(result.method, result.method)
        if self._recorder is not None:
            add_result(folder, record, "telemetry", self._recorder.to_telemetry(), self.product.path)
        add_result(folder, record, "loop", result, self.product.path)
        document = save_run(
            folder, record, "loop", f"Closed loop on {record.system}", wall_seconds,
            **loop_document(result),
            im=self.product.path.absolute(),
            criteria=[] if result.partial else criteria.loop_criteria({label: result}),
            labels={"loop": {"label": label}},
        )  # fmt: skip
        return SavedRun(document, result.stable)
