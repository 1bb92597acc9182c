"""Modulation-demodulation: drives batches of modes as sinusoids on distinct frequencies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import snr_per_mode
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult, TemporalResponse
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import (
    build_interaction_matrix,
    next_frame,
    validate_frame_count,
)
from escape_hw.calibration.acquisition.pokes import compute_poke_amplitudes
from escape_hw.calibration.acquisition.preview import MatrixPreview
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function, ensure_sensor_ready
from escape_hw.calibration.acquisition.stopping import Target, reject_accuracy_target
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.push_pull.demodulation import (
    SpectralLines,
    choose_line_frequencies,
    compute_matrix,
    estimate_delay,
    fit_lines,
)
from escape_hw.calibration.push_pull.run_state import MAX_ROUNDS, ModeByModeRun
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.io.fits.run_state import RunState

#: Band of the lines in cycles per frame: above most of the turbulence and vibrations, and below frequencies
#: at which the mirror hardly responds.
BAND = (0.1, 0.4)
#: Frames at the start of a batch in which the motion of the mirror settles.
_SETTLING_FRAMES = 10
#: Least mean squared ratio of the elements to their standard errors; 1 for noise alone.
_MIN_MEAN_POWER = 2.0


def modulation_demodulation(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    grid: SensorGeometry | None = None,
    until: Target | None = None,
    checkpoint: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """Drive batches of modes as sinusoids and demodulate the slopes.

    See Esposito et al. (2006) and Pinna et al. (2012). Works on a calibration source and under
    turbulence.

    Parameters
    ----------
    bench
        An open bench, loop open.
    frames
        Frames per batch; by default as configured (``calibration.modulated_frames``).
    poke
        Amplitude of each mode, rms surface as fraction of full stroke; by default as configured.
    grid
        Geometry of the sensor; found first if not given.
    until
        Repeat each batch until all its modes have this signal-to-noise ratio, at most
        :data:`~escape_hw.calibration.push_pull.run_state.MAX_ROUNDS` times.
    checkpoint
        Where the state is saved, and the state to resume from.

    Returns
    -------
    CalibrationResult
        With the delay from the phases of all lines. After an abort ``partial`` is true and the modes of later
        batches are left out.

    Raises
    ------
    ConfigError
        The number of frames, the poke or the target is out of range; nothing moved.
    ProductError
        The state to resume from is damaged or of another run; nothing moved.
    TooFewFrames
        Too few frames for a single line.
    CalibrationError
        No spots or pupil images, no light, or no response.
    Aborted
        Aborted before the first batch was measured.
    """
    c = bench.config.calibration
    n_frames = c.modulated_frames if frames is None else validate_frame_count(frames)
    m2c = build_modal_basis(bench)
    amplitude = compute_poke_amplitudes(bench, m2c, c.poke if poke is None else poke)
    n_modes = m2c.shape[1]
    modes_per_batch = choose_line_frequencies(n_modes, n_frames, BAND).size
    batches = np.array_split(np.arange(n_modes), -(-n_modes // modes_per_batch))
    reject_accuracy_target(until)
    settings = {"poke": float(amplitude.max()), "frames": n_frames}
    state = None if checkpoint is None else checkpoint.begin(bench, "modulated", m2c, settings)
    try:
        grid, mean_frame = yield from ensure_sensor_ready(bench, grid if state is None else state.grid)
        report = Reporter("modulation", len(batches) * (n_frames + _SETTLING_FRAMES))
        run = _ModulationRun(
            bench, build_slope_function(bench, grid), report, mean_frame, checkpoint, frames=n_frames
        )
        if state is not None:
            run.restore(state)
        partial, preview = False, MatrixPreview(n_modes, lambda: grid)
        try:
            for modes in batches[len(run.batch_lines) :]:
                yield from run.measure(m2c[:, modes], amplitude[modes], until)
                if preview.is_due():
                    yield report.now(preview(lambda: run.estimate_matrix(c.lags)))
        except Aborted:
            run.save_if_due(final=True)
            if not run.batch_lines:
                raise
            partial = True
    finally:
        bench.dm.flatten()
    lines = _concatenate_lines(run.batch_lines)
    delay, error = estimate_delay(lines, c.lags - 1)
    data, sigma = compute_matrix(lines, delay)
    if np.mean(np.square(data / np.maximum(sigma, 1e-300))) < _MIN_MEAN_POWER:
        raise CalibrationError(
            "the sensor does not respond to the mirror; check that the light is on and the mirror moves"
        )
    delivered, lost = run.count_frames()
    matrix = build_interaction_matrix(
        bench, grid, m2c[:, : data.shape[1]], data, sigma, "modulated",
        frames=delivered, lost_frames=lost, poke=float(amplitude.max()), batches=len(run.batch_lines),
        delay_frames=delay, delay_sigma=error,
    )  # fmt: skip
    return CalibrationResult(
        matrix, run.slope_statistics.annotate_geometry(grid), delivered, lost,
        (delivered + lost) / bench.wfs.settings.frame_rate_hz, _as_temporal_response(delay, error, c.lags),
        partial=partial, mean_frame=run.mean_frame,
    )  # fmt: skip


class _ModulationRun(ModeByModeRun):
    """Batches measured so far, of ``frames`` frames each."""

    def __init__(self, *args: Any, frames: int) -> None:
        super().__init__(*args)
        self.frames = frames
        self.batch_lines: list[SpectralLines] = []

    def restore(self, state: RunState) -> None:
        super().restore(state)
        parts = state.arrays
        self.batch_lines = [
            SpectralLines(
                parts[f"real{k}"] + 1j * parts[f"imaginary{k}"], parts[f"sigma{k}"], parts[f"frequency{k}"]
            )
            for k in range(int(state.values["batches"]))
        ]

    def measure(
        self, m2c: NDArray[np.float64], amplitude: NDArray[np.float64], until: Target | None
    ) -> Procedure[None]:
        """Drive one batch, repeatedly until its modes have the target's signal-to-noise ratio."""
        rounds: list[SpectralLines] = []
        for _ in range(MAX_ROUNDS if until is not None else 1):
            rounds.append((yield from _measure_batch(self, m2c, amplitude)))
            lines = _average_lines(rounds)
            # Of real and imaginary part together, which the response rotates into each other.
            size = np.sqrt(np.maximum(np.square(np.abs(lines.amplitude)) - np.square(lines.sigma), 0.0))
            if until is None or until.snr is None or snr_per_mode(size, lines.sigma).min() >= until.snr:
                break
        self.batch_lines.append(lines)
        self.save_if_due()

    def estimate_matrix(self, lags: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Matrix and standard errors of the batches so far ``(n_slopes, n)``."""
        lines = _concatenate_lines(self.batch_lines)
        return compute_matrix(lines, estimate_delay(lines, lags - 1)[0])

    def save_if_due(self, *, final: bool = False) -> None:
        arrays: dict[str, NDArray[Any]] = {}
        for k, lines in enumerate(self.batch_lines):
            arrays[f"real{k}"], arrays[f"imaginary{k}"] = lines.amplitude.real, lines.amplitude.imag
            arrays[f"sigma{k}"], arrays[f"frequency{k}"] = lines.sigma, lines.frequency
        if self.batch_lines:
            self.checkpoint({"batches": len(self.batch_lines)}, arrays, final)


def _average_lines(rounds: list[SpectralLines]) -> SpectralLines:
    """Mean of the same lines from several rounds."""
    variance = np.sum([np.square(lines.sigma) for lines in rounds], axis=0)
    amplitude = np.mean([lines.amplitude for lines in rounds], axis=0)
    return SpectralLines(amplitude, np.sqrt(variance) / len(rounds), rounds[0].frequency)


def _measure_batch(
    run: _ModulationRun, m2c: NDArray[np.float64], amplitude: NDArray[np.float64]
) -> Procedure[SpectralLines]:
    """Drive some modes for a batch of frames and fit their lines."""
    bench, frames = run.bench, run.frames
    frequency = choose_line_frequencies(amplitude.size, frames, BAND)
    # Quadratic phases minimise the peak of the sum of many sinusoids (Schroeder 1970).
    phase = np.pi * np.arange(amplitude.size) ** 2 / amplitude.size
    sinusoids = amplitude * np.sin(np.outer(np.arange(frames + _SETTLING_FRAMES), frequency) + phase)
    shapes = sinusoids @ m2c.T
    scale = _amplitude_scale(bench, shapes)
    times: list[int] = []
    slope_rows: list[NDArray[np.float32]] = []
    first = None
    while not times or times[-1] + 1 < len(shapes):
        frame = next_frame(bench)
        first = frame.index if first is None else first
        # By the camera's frame index, so that a lost frame delays one shape and shifts none.
        step = frame.index - first
        slopes = run.slopes_of(frame.data)
        run.flux_monitor(run.slopes_of.flux)
        run.slope_statistics.add(slopes)
        times.append(step)
        slope_rows.append(slopes)
        bench.dm.send(shapes[min(step, len(shapes) - 1)] * scale)
        if progress := run.report.step():
            yield progress
    bench.dm.flatten()
    time = np.array(times, np.int64)
    settled = time >= _SETTLING_FRAMES
    lines = fit_lines(time[settled], np.stack(slope_rows)[settled], frequency, amplitude * scale, frames)
    phase_correction = np.exp(-1j * phase)
    return SpectralLines(lines.amplitude * phase_correction, lines.sigma, frequency)


def _amplitude_scale(bench: Bench, shapes: NDArray[np.float64]) -> float:
    """Largest factor up to 1 with which a sequence of shapes is within the mirror's limits."""
    dm = bench.dm
    scale = min(1.0, *(float(dm.largest_legal_scale(shape)) for shape in shapes))
    if dm.limits.max_slew is not None:
        largest_step = np.abs(np.diff(shapes, axis=0, prepend=0.0)).max()
        scale = min(scale, dm.limits.max_slew / max(float(largest_step), 1e-300))
    return scale


def _concatenate_lines(batch_lines: list[SpectralLines]) -> SpectralLines:
    return SpectralLines(
        np.concatenate([lines.amplitude for lines in batch_lines], axis=1),
        np.concatenate([lines.sigma for lines in batch_lines], axis=1),
        np.concatenate([lines.frequency for lines in batch_lines]),
    )


def _as_temporal_response(delay: float, error: float, lags: int) -> TemporalResponse:
    """The delay as a temporal response with weights of whole frames."""
    whole_frames = min(int(delay), lags - 2)
    weights, sigma = np.zeros(lags), np.zeros(lags)
    weights[whole_frames : whole_frames + 2] = 1 - (delay - whole_frames), delay - whole_frames
    sigma[whole_frames : whole_frames + 2] = error
    return TemporalResponse(weights, sigma)
