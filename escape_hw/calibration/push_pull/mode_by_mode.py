"""What the measurements mode by mode share: sensor set-up, repetitions, checkpoints, abort, result."""

from __future__ import annotations

import abc
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import snr_per_mode
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult, TemporalResponse
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import FluxMonitor, build_interaction_matrix
from escape_hw.calibration.acquisition.pokes import compute_poke_amplitudes, note_limited_poke
from escape_hw.calibration.acquisition.preview import MatrixPreview
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function, ensure_sensor_ready
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics
from escape_hw.calibration.acquisition.stopping import Target, reject_accuracy_target
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.errors import Aborted
from escape_hw.io.fits.run_state import RunState

#: Largest number of repetitions of a step, to reach a signal-to-noise ratio.
MAX_ROUNDS = 16

#: Values of a step, and their standard errors.
Measurement = tuple[NDArray[Any], NDArray[np.float64]]


class ModeByModeRun(abc.ABC):
    """A measurement in steps of one mode or of a batch of modes; nothing moves on construction.

    Parameters
    ----------
    poke, frames
        Amplitude, rms surface as fraction of full stroke, and frames of a step.
    until
        Repeat each step until all its modes have this signal-to-noise ratio, at most :data:`MAX_ROUNDS`
        times.
    checkpoint
        Where the state is saved, and the state to resume from.

    Raises
    ------
    ConfigError
        The poke or the target is out of range.
    """

    method: ClassVar[str]
    grid: SensorGeometry
    slopes_of: SlopeFunction
    report: Reporter
    mean_frame: NDArray[np.float32] | None

    def __init__(
        self, bench: Bench, poke: float, frames: int, until: Target | None, checkpoint: Checkpoint | None
    ) -> None:
        self.bench, self.frames, self._until, self._checkpoint = bench, frames, until, checkpoint
        self.m2c = build_modal_basis(bench)
        self.amplitude = compute_poke_amplitudes(bench, self.m2c, poke)
        self._notes = tuple(note_limited_poke(bench, self.amplitude, poke))
        reject_accuracy_target(until)
        self.steps: list[Measurement] = []

    @property
    @abc.abstractmethod
    def n_steps(self) -> int:
        """Number of steps in all."""

    @property
    def references(self) -> str:
        """As for :func:`~escape_hw.calibration.acquisition.sensor_setup.find_sensor`."""
        return "design"

    @abc.abstractmethod
    def measure_step(self, step: int) -> Procedure[Measurement]:
        """Measure the modes of a step once."""

    @abc.abstractmethod
    def estimate_matrix(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix and standard errors of the modes so far ``(n_slopes, n)``."""

    @abc.abstractmethod
    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        """Values and arrays from which :meth:`restore_steps` continues."""

    @abc.abstractmethod
    def restore_steps(self, state: RunState) -> None:
        """Continue from a saved state."""

    @abc.abstractmethod
    def prepare(self) -> Procedure[Reporter]:
        """Prepare the first step once the sensor is set up; returns the reporter of all frames."""

    def measure(self, grid: SensorGeometry | None, settings: Mapping[str, Any]) -> Procedure[bool]:
        """Measure all steps; the mirror is flat in the end.

        ``grid``: geometry of the sensor; found first if not given; ``settings``: plain values that must be
        the same when the run is resumed.

        Returns whether the run was aborted after its first step; before, :class:`Aborted` is raised.
        """
        bench, checkpoint = self.bench, self._checkpoint
        state = None if checkpoint is None else checkpoint.begin(bench, self.method, self.m2c, settings)
        try:
            self.grid, self.mean_frame = yield from ensure_sensor_ready(
                bench, grid if state is None else state.grid, self.references
            )
            self.slopes_of = build_slope_function(bench, self.grid)
            self.report = yield from self.prepare()
            self.slope_statistics = SlopeStatistics(self.grid.n_slopes)
            self.flux_monitor = FluxMonitor(bench.wfs.name, self.grid)
            self._start_status, self._resumed_counts = bench.wfs.status(), (0, 0)
            if state is not None:
                self._restore(state)
            preview = MatrixPreview(self.m2c.shape[1], lambda: self.grid)
            try:
                for step in range(len(self.steps), self.n_steps):
                    self.steps.append((yield from self._measure_repeatedly(step)))
                    self._save()
                    if preview.is_due():
                        yield self.report.now(preview(self.estimate_matrix))
            except Aborted:
                self._save(final=True)
                if not self.steps:
                    raise
                return True
        finally:
            bench.dm.flatten()
        return False

    def _measure_repeatedly(self, step: int) -> Procedure[Measurement]:
        """Mean of repeated measurements of a step, until it has the target's signal-to-noise ratio."""
        rounds: list[Measurement] = []
        snr = None if self._until is None else self._until.snr
        while True:
            rounds.append((yield from self.measure_step(step)))
            value = np.mean([one for one, _ in rounds], axis=0)
            sigma = np.sqrt(np.sum([np.square(error) for _, error in rounds], axis=0)) / len(rounds)
            if snr is None or len(rounds) == MAX_ROUNDS:
                return value, sigma
            # Of real and imaginary part together, which a temporal response rotates into each other.
            if np.iscomplexobj(value):
                size = np.sqrt(np.maximum(np.square(np.abs(value)) - np.square(sigma), 0.0))
            else:
                size = value
            if snr_per_mode(size, sigma).min() >= snr:
                return value, sigma

    def _count_frames(self) -> tuple[int, int]:
        """Number of frames delivered and lost, including those of a resumed run."""
        now = self.bench.wfs.status()
        delivered, lost = now.delivered - self._start_status.delivered, now.lost - self._start_status.lost
        return self._resumed_counts[0] + delivered, self._resumed_counts[1] + lost

    def _restore(self, state: RunState) -> None:
        self.mean_frame = state.arrays.get("mean_frame", self.mean_frame)
        self.slope_statistics.restore(state.arrays["motion"])
        self._resumed_counts = int(state.values["delivered"]), int(state.values["lost"])
        self.restore_steps(state)

    def _save(self, *, final: bool = False) -> None:
        """Save the state, if it is time or this is the ``final`` one, and if there is anything to save."""
        if not self.steps or self._checkpoint is None or not (final or self._checkpoint.is_due()):
            return
        values, arrays = self.state()
        delivered, lost = self._count_frames()
        arrays["motion"] = self.slope_statistics.state()
        if self.mean_frame is not None:
            arrays["mean_frame"] = self.mean_frame
        self._checkpoint.save({**values, "delivered": delivered, "lost": lost}, arrays, self.grid)

    def build_result(
        self,
        data: NDArray[np.float64],
        sigma: NDArray[np.float64],
        partial: bool,
        response: TemporalResponse | None = None,
        **metrics: float | int,
    ) -> CalibrationResult:
        """Build the calibration from matrix and standard errors of the modes measured ``(n_slopes, n)``."""
        delivered, lost = self._count_frames()
        matrix = build_interaction_matrix(
            self.bench, self.grid, self.m2c[:, : data.shape[1]], data, sigma, self.method,
            frames=delivered, lost_frames=lost, poke=float(self.amplitude.max()), **metrics,
        )  # fmt: skip
        return CalibrationResult(
            matrix, self.slope_statistics.annotate_geometry(self.grid), delivered, lost,
            (delivered + lost) / self.bench.wfs.settings.frame_rate_hz, response,
            partial=partial, mean_frame=self.mean_frame, notes=self._notes,
        )  # fmt: skip
