"""Push-pull: interaction matrix column by column from positive and negative pokes (paper, Methodology)."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import snr_per_mode
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import (
    FluxMonitor,
    build_interaction_matrix,
    next_frame,
    ramp_to,
    validate_frame_count,
)
from escape_hw.calibration.acquisition.pokes import compute_poke_amplitudes
from escape_hw.calibration.acquisition.preview import MatrixPreview
from escape_hw.calibration.acquisition.sensor_setup import (
    build_slope_function,
    ensure_sensor_ready,
    get_sensor_kind,
)
from escape_hw.calibration.acquisition.stopping import Target, reject_accuracy_target
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.push_pull.run_state import MAX_ROUNDS, ModeByModeRun
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.io.fits.run_state import RunState

#: Frames after a test step from which the settling time is found.
_STEP_FRAMES = 30
#: Relative deviation from the final response below which it has settled.
_SETTLED_FRACTION = 0.02
#: Relative scatter of the final response above which there is none.
_MAX_SCATTER = 0.3


def _find_settling_frames(
    bench: Bench, slopes_of: SlopeFunction, command: NDArray[np.float64]
) -> Procedure[int]:
    """Find the number of frames to skip after a step, by a test step ``command (n_act,)``.

    Raises
    ------
    CalibrationError
        The sensor does not respond to the mirror.
    """
    report = Reporter("test step", _STEP_FRAMES)
    reference = (yield from _acquire_slopes(bench, slopes_of, _STEP_FRAMES // 3, report)).mean(axis=0)
    try:
        ramp_to(bench.dm, command)
        steps = (yield from _acquire_slopes(bench, slopes_of, _STEP_FRAMES, report)) - reference
    finally:
        bench.dm.flatten()
    end = steps[_STEP_FRAMES // 2 :]
    direction = end.mean(axis=0)
    response = steps @ direction / float(direction @ direction)
    scatter = float((end @ direction).std() / (direction @ direction))
    if not scatter < _MAX_SCATTER:
        raise CalibrationError(
            "the wavefront sensor does not respond to a test step of the mirror; "
            "is the light on, and is the turbulence out of the beam?"
        )
    # Noise and vibration may exceed the band later on; only the first half counts.
    off = np.flatnonzero(np.abs(response[: _STEP_FRAMES // 2] - 1) > _SETTLED_FRACTION + 3 * scatter)
    return int(off[-1]) + 2 if off.size else 1


def push_pull(
    bench: Bench,
    *,
    poke: float | None = None,
    frames: int | None = None,
    grid: SensorGeometry | None = None,
    until: Target | None = None,
    checkpoint: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Push and pull every mode and average the slopes: ``D_i = (s(+a e_i) - s(-a e_i)) / 2 a`` (paper).

    Needs a calibration source; turbulence would dominate the result.

    Parameters
    ----------
    bench
        An open bench without turbulence.
    poke
        Amplitude, rms surface as fraction of full stroke; by default as configured.
    frames
        Frames averaged per push and per pull; by default as configured.
    grid
        Geometry of the sensor; found first if not given.
    until
        Repeat each mode until it has this signal-to-noise ratio, at most
        :data:`~escape_hw.calibration.push_pull.run_state.MAX_ROUNDS` times.
    checkpoint
        Where the state is saved, and the state to resume from.

    Returns
    -------
    CalibrationResult
        Standard errors are from the scatter of the frames. After an abort ``partial`` is true and the modes
        not measured yet are left out.

    Raises
    ------
    ConfigError
        The number of frames, the poke or the target is out of range; nothing moved.
    ProductError
        The state to resume from is damaged or of another run; nothing moved.
    CalibrationError
        No spots or pupil images, no light, or no response.
    Aborted
        Aborted before the first mode was measured.
    """
    c = bench.config.calibration
    n_frames = c.push_pull_frames if frames is None else validate_frame_count(frames)
    poke = c.push_pull_poke if poke is None else poke
    m2c = build_modal_basis(bench)
    amplitude = compute_poke_amplitudes(bench, m2c, poke)
    reject_accuracy_target(until)
    settings = {"poke": poke, "frames": n_frames}
    state = None if checkpoint is None else checkpoint.begin(bench, "push-pull", m2c, settings)
    known_grid = grid if state is None else state.grid
    try:
        grid, mean_frame = yield from ensure_sensor_ready(
            bench, known_grid, get_sensor_kind(bench).source_references
        )
        slopes_of = build_slope_function(bench, grid)
        skip = yield from _find_settling_frames(bench, slopes_of, m2c[:, 0] * amplitude[0] * 3)
        report = Reporter("push-pull", m2c.shape[1] * 2 * (skip + n_frames))
        run = _PushPullRun(bench, slopes_of, report, mean_frame, checkpoint, skip=skip, frames=n_frames)
        if state is not None:
            run.restore(state)
        partial, preview = False, MatrixPreview(m2c.shape[1], lambda: grid)
        try:
            for mode in range(len(run.columns), m2c.shape[1]):
                yield from run.measure(m2c[:, mode], amplitude[mode], until)
                if preview.is_due():
                    yield report.now(preview(run.estimate_matrix))
        except Aborted:
            run.save_if_due(final=True)
            if not run.columns:
                raise
            partial = True
    finally:
        bench.dm.flatten()
    delivered, lost = run.count_frames()
    data, sigma = run.estimate_matrix()
    matrix = build_interaction_matrix(
        bench, grid, m2c[:, : data.shape[1]], data, sigma, "push-pull",
        frames=delivered, lost_frames=lost, poke=float(poke), settling_frames=skip,
    )  # fmt: skip
    return CalibrationResult(
        matrix, run.slope_statistics.annotate_geometry(grid), delivered, lost,
        (delivered + lost) / bench.wfs.settings.frame_rate_hz, partial=partial, mean_frame=run.mean_frame,
    )  # fmt: skip


class _PushPullRun(ModeByModeRun):
    """Modes measured so far; after each step ``skip`` frames are skipped and ``frames`` averaged."""

    def __init__(self, *args: Any, skip: int, frames: int) -> None:
        super().__init__(*args)
        self.skip, self.frames = skip, frames
        self.columns: list[NDArray[np.float64]] = []
        self.errors: list[NDArray[np.float64]] = []

    def restore(self, state: RunState) -> None:
        super().restore(state)
        self.columns, self.errors = list(state.arrays["columns"]), list(state.arrays["errors"])

    def measure(self, shape: NDArray[np.float64], amplitude: float, until: Target | None) -> Procedure[None]:
        """Push and pull one mode ``(n_act,)``, repeatedly until it has the target's signal-to-noise ratio."""
        columns, variances = [], []
        for _ in range(MAX_ROUNDS if until is not None else 1):
            column, error = yield from _measure_mode(self, shape, amplitude)
            columns.append(column)
            variances.append(np.square(error))
            column = np.mean(columns, axis=0)
            error = np.sqrt(np.sum(variances, axis=0)) / len(columns)
            if until is None or until.snr is None or snr_per_mode(column, error) >= until.snr:
                break
        self.columns.append(column)
        self.errors.append(error)
        self.save_if_due()

    def estimate_matrix(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Columns and their standard errors ``(n_slopes, n)``."""
        return np.stack(self.columns, 1), np.stack(self.errors, 1)

    def save_if_due(self, *, final: bool = False) -> None:
        if self.columns:
            self.checkpoint({}, {"columns": np.array(self.columns), "errors": np.array(self.errors)}, final)


def _measure_mode(
    run: _PushPullRun, shape: NDArray[np.float64], amplitude: float
) -> Procedure[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Measure the column of one mode and its standard errors, each ``(n_slopes,)``."""
    means, variances, sent = [], [], []
    for sign in (1.0, -1.0):
        # The amplitude as sent, which the limits may have reduced.
        sent_command = ramp_to(run.bench.dm, sign * amplitude * shape).sent
        sent.append(float(sent_command @ shape / (shape @ shape)))
        stack = yield from _acquire_slopes(
            run.bench, run.slopes_of, run.skip + run.frames, run.report, run.flux_monitor
        )
        stack = stack[run.skip :]
        for slopes in stack:
            run.slope_statistics.add(slopes)
        means.append(stack.mean(axis=0, dtype=np.float64))
        if run.frames > 1:
            variances.append(stack.var(axis=0, ddof=1, dtype=np.float64) / run.frames)
        else:
            variances.append(np.full(stack.shape[1], np.nan))
    amplitude_difference = sent[0] - sent[1]
    if not amplitude_difference > 0:
        raise CalibrationError("the limits left nothing of a poke; lower calibration.push_pull_poke")
    column = (means[0] - means[1]) / amplitude_difference
    return column, np.sqrt(variances[0] + variances[1]) / amplitude_difference


def _acquire_slopes(
    bench: Bench,
    slopes_of: SlopeFunction,
    frames: int,
    report: Reporter,
    flux_monitor: FluxMonitor | None = None,
) -> Procedure[NDArray[np.float32]]:
    """Slopes of the next frames ``(frames, n_slopes)``."""
    stack = np.empty((frames, slopes_of.grid.n_slopes), np.float32)
    for row in stack:
        row[:] = slopes_of(next_frame(bench).data)
        if flux_monitor is not None:
            flux_monitor(slopes_of.flux)
        if progress := report.step():
            yield progress
    return stack
