"""Modulation-demodulation: drives batches of modes as sinusoids on distinct frequencies."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult, TemporalResponse
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.checkpoint import Checkpoint
from escape_hw.calibration.acquisition.frames import next_frame, validate_frame_count
from escape_hw.calibration.acquisition.stopping import Target
from escape_hw.calibration.push_pull.demodulation import (
    SpectralLines,
    choose_line_frequencies,
    compute_matrix,
    estimate_delay,
    fit_lines,
)
from escape_hw.calibration.push_pull.mode_by_mode import Measurement, ModeByModeRun
from escape_hw.errors import CalibrationError
from escape_hw.io.fits.run_state import RunState

#: Band of the lines in cycles per frame: above most of the turbulence and vibrations, and below frequencies
#: at which the mirror hardly responds.
BAND = (0.1, 0.4)
#: Frames at the start of a batch in which the motion of the mirror settles.
SETTLING_FRAMES = 10
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
    poke, grid, until, checkpoint
        As for :func:`~escape_hw.calibration.push_pull.procedure.push_pull`, with batches for modes.

    Returns
    -------
    CalibrationResult
        With the delay from the phases of all lines. After an abort ``partial`` is true and the modes of later
        batches are left out.

    Raises
    ------
    ConfigError, ProductError, CalibrationError, Aborted
        As for :func:`~escape_hw.calibration.push_pull.procedure.push_pull`.
    TooFewFrames
        Too few frames for a single line; nothing moved.
    """
    c = bench.config.calibration
    n_frames = c.modulated_frames if frames is None else validate_frame_count(frames)
    run = _ModulationRun(bench, c.poke if poke is None else poke, n_frames, until, checkpoint)
    partial = yield from run.measure(grid, {"poke": float(run.amplitude.max()), "frames": n_frames})
    lines = run.all_lines()
    delay, error = estimate_delay(lines, c.lags - 1)
    data, sigma = compute_matrix(lines, delay)
    if np.mean(np.square(data / np.maximum(sigma, 1e-300))) < _MIN_MEAN_POWER:
        raise CalibrationError(
            "the sensor does not respond to the mirror; check that the light is on and the mirror moves"
        )
    return run.build_result(
        data, sigma, partial, _as_temporal_response(delay, error, c.lags),
        batches=len(run.steps), delay_frames=delay, delay_sigma=error,
    )  # fmt: skip


class _ModulationRun(ModeByModeRun):
    """One batch of modes per step of ``frames`` frames."""

    method = "modulated"

    def __init__(
        self, bench: Bench, poke: float, frames: int, until: Target | None, checkpoint: Checkpoint | None
    ) -> None:
        super().__init__(bench, poke, frames, until, checkpoint)
        n_modes = self.m2c.shape[1]
        modes_per_batch = choose_line_frequencies(n_modes, frames, BAND).size
        self._batches = np.array_split(np.arange(n_modes), -(-n_modes // modes_per_batch))
        self._frequencies = [choose_line_frequencies(batch.size, frames, BAND) for batch in self._batches]

    @property
    def n_steps(self) -> int:
        return len(self._batches)

    def prepare(self) -> Procedure[Reporter]:
        yield from ()
        return Reporter("modulation", self.n_steps * (self.frames + SETTLING_FRAMES))

    def measure_step(self, step: int) -> Procedure[Measurement]:
        """Drive the modes of a batch and fit their lines ``(n_slopes, n)``."""
        bench, frequency = self.bench, self._frequencies[step]
        m2c, amplitude = self.m2c[:, self._batches[step]], self.amplitude[self._batches[step]]
        # Quadratic phases minimise the peak of the sum of many sinusoids (Schroeder 1970).
        phase = np.pi * np.arange(amplitude.size) ** 2 / amplitude.size
        n_shapes = self.frames + SETTLING_FRAMES
        sinusoids = amplitude * np.sin(np.outer(np.arange(n_shapes), frequency) + phase)
        shapes = sinusoids @ m2c.T
        scale = _amplitude_scale(bench, shapes)
        times: list[int] = []
        slope_rows: list[NDArray[np.float32]] = []
        first = None
        while not times or times[-1] + 1 < n_shapes:
            frame = next_frame(bench)
            first = frame.index if first is None else first
            # By the camera's frame index, so that a lost frame delays one shape and shifts none.
            time = frame.index - first
            slopes = self.slopes_of(frame.data)
            self.flux_monitor(self.slopes_of.flux)
            self.slope_statistics.add(slopes)
            times.append(time)
            slope_rows.append(slopes)
            bench.dm.send(shapes[min(time, n_shapes - 1)] * scale)
            if progress := self.report.step():
                yield progress
        bench.dm.flatten()
        at = np.array(times, np.int64)
        settled = at >= SETTLING_FRAMES
        lines = fit_lines(
            at[settled], np.stack(slope_rows)[settled], frequency, amplitude * scale, self.frames
        )
        return lines.amplitude * np.exp(-1j * phase), lines.sigma

    def all_lines(self) -> SpectralLines:
        """Lines of all batches so far."""
        amplitudes, sigmas = zip(*self.steps, strict=True)
        frequencies = self._frequencies[: len(self.steps)]
        return SpectralLines(
            np.concatenate(amplitudes, axis=1), np.concatenate(sigmas, axis=1), np.concatenate(frequencies)
        )

    def estimate_matrix(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        lines = self.all_lines()
        return compute_matrix(lines, estimate_delay(lines, self.bench.config.calibration.lags - 1)[0])

    def state(self) -> tuple[dict[str, Any], dict[str, NDArray[Any]]]:
        arrays: dict[str, NDArray[Any]] = {}
        for k, (amplitude, sigma) in enumerate(self.steps):
            arrays[f"real{k}"], arrays[f"imaginary{k}"], arrays[f"sigma{k}"] = (
                amplitude.real, amplitude.imag, sigma,
            )  # fmt: skip
        return {"batches": len(self.steps)}, arrays

    def restore_steps(self, state: RunState) -> None:
        parts = state.arrays
        self.steps = [
            (parts[f"real{k}"] + 1j * parts[f"imaginary{k}"], parts[f"sigma{k}"])
            for k in range(int(state.values["batches"]))
        ]


def _amplitude_scale(bench: Bench, shapes: NDArray[np.float64]) -> float:
    """Largest factor up to 1 with which a sequence of shapes is within the mirror's limits."""
    dm = bench.dm
    scale = min(1.0, *(float(dm.largest_legal_scale(shape)) for shape in shapes))
    if dm.limits.max_slew is not None:
        largest_step = np.abs(np.diff(shapes, axis=0, prepend=0.0)).max()
        scale = min(scale, dm.limits.max_slew / max(float(largest_step), 1e-300))
    return scale


def _as_temporal_response(delay: float, error: float, lags: int) -> TemporalResponse:
    """The delay as a temporal response with weights of whole frames."""
    whole_frames = min(int(delay), lags - 2)
    weights, sigma = np.zeros(lags), np.zeros(lags)
    weights[whole_frames : whole_frames + 2] = 1 - (delay - whole_frames), delay - whole_frames
    sigma[whole_frames : whole_frames + 2] = error
    return TemporalResponse(weights, sigma)
