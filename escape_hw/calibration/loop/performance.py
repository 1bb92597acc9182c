"""Closing the loop with a matrix, and judging it."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Camera
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import LoopResult, StrehlEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import next_frame, validate_frame_count
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function, prepare_sensor
from escape_hw.calibration.loop.runner import SETTLING_S, LoopRecord, RunningLoop, minimum_strehl_frames
from escape_hw.errors import Aborted, CalibrationError, ConfigError, IncompatibleProduct
from escape_hw.pipeline.control.integrator import LeakyIntegrator
from escape_hw.pipeline.control.reconstructor import reconstructor
from escape_hw.pipeline.psf.strehl import strehl, subtract_background
from escape_hw.pipeline.statistics import MIN_SAMPLES


def close_loop(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    *,
    gain: float | None = None,
    leak: float | None = None,
    dropped_modes: int | None = None,
    frames: int = 5000,
    model_psf: NDArray[np.float32] | None = None,
    stage: str = "closed loop",
) -> Procedure[LoopResult]:
    """Close the loop for a number of frames and open it again.

    Parameters
    ----------
    bench
        An open bench.
    matrix, grid
        The interaction matrix and the sensor's grid that it belongs to.
    gain, leak, dropped_modes
        Loop parameters; as configured by default.
    frames
        How long.
    model_psf
        PSF without turbulence; with it, and with a science camera, the Strehl ratios are measured.
    stage
        Name of the stage in progress reports.

    Returns
    -------
    LoopResult
        ``stable`` is false when the loop was opened because it diverged.

    Raises
    ------
    ConfigError
        A gain, leak or number of frames that means nothing; nothing moved.
    IncompatibleProduct
        The matrix belongs to another mirror, grid or camera region; nothing moved.
    CalibrationError
        The matrix cannot be inverted, or the sensor went dark.
    """
    validate_frame_count(frames)
    control = build_integrator(bench, matrix, grid, gain=gain, leak=leak, dropped_modes=dropped_modes)
    c = bench.config.loop
    prepare_sensor(bench)
    slopes_of = build_slope_function(bench, grid)
    partial = False
    science = bench.science if model_psf is not None else None
    loop = RunningLoop(bench, matrix.m2c, slopes_of, control, science=science is not None)
    record = loop.record
    bench.dm.flatten()
    # One frame first: what the camera lost while nobody read it is not a loss of the loop.
    next_frame(bench)
    lost, started = bench.wfs.status().lost, bench.wfs.now_ns()
    if science is not None:
        science.stop()
    try:
        yield from loop.run(frames, report=Reporter(stage, frames))
    except Aborted:
        partial = True
    finally:
        bench.dm.flatten()
        if science is not None:
            science.stop()
    seconds = max((bench.wfs.now_ns() - started) * 1e-9, 1e-9)
    images, ratio, notes = _evaluate_images(bench, record, seconds, model_psf)
    residual = np.array(record.residual, dtype=np.float32)
    settled = residual[len(residual) // 10 :]
    return LoopResult(
        method=matrix.method, gain=c.gain if gain is None else gain, leak=c.leak if leak is None else leak,
        dropped_modes=c.dropped_modes if dropped_modes is None else dropped_modes, frames=record.frames,
        lost_frames=bench.wfs.status().lost - lost, rate_hz=record.frames / seconds,
        stable=not record.diverged and is_steady(residual),
        residual_rms_nm=float(np.sqrt(np.mean(np.square(settled)))) if settled.size else math.nan,
        strehl=ratio, latency_us=latency_percentiles(record.latency),
        psf=_subtract_background(images.mean(axis=0)) if len(images) else None,
        model_psf=model_psf, residual_nm=residual[:: max(1, residual.size // 2000)],
        last_command=record.command, last_frame=None if record.last is None else record.last.data,
        partial=partial, notes=tuple(notes),
    )  # fmt: skip


def build_integrator(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    *,
    gain: float | None = None,
    leak: float | None = None,
    dropped_modes: int | None = None,
) -> LeakyIntegrator:
    """The integrator that closes the loop with a matrix; nothing moves.

    Parameters
    ----------
    bench, matrix, grid, gain, leak, dropped_modes
        As for :func:`close_loop`.

    Raises
    ------
    ConfigError, IncompatibleProduct, CalibrationError
        As for :func:`close_loop`.
    """
    c = bench.config.loop
    gain = c.gain if gain is None else gain
    leak = c.leak if leak is None else leak
    if not (0 < gain < math.inf and 0 <= leak <= 1):
        raise ConfigError(f"gain is {gain} and leak {leak}; the gain must be positive, the leak in [0, 1]")
    _require_compatible(bench, matrix, grid)
    stroke = np.sqrt(np.mean(np.square(matrix.m2c), axis=0))
    dropped = c.dropped_modes if dropped_modes is None else dropped_modes
    return LeakyIntegrator(reconstructor(matrix.data, scale=stroke, dropped_modes=dropped), gain, leak)


def _require_compatible(bench: Bench, matrix: InteractionMatrix, grid: SensorGeometry) -> None:
    """Raise :class:`IncompatibleProduct` unless mirror, matrix and grid belong together."""
    if matrix.m2c.shape[0] != bench.dm.info.n_act or matrix.n_slopes != grid.n_slopes:
        raise IncompatibleProduct(
            f"the matrix is for {matrix.m2c.shape[0]} actuators and {matrix.n_slopes} slopes; "
            f"this bench has {bench.dm.info.n_act} and {grid.n_slopes}"
        )
    if not np.array_equal(matrix.valid, grid.valid):
        raise IncompatibleProduct(f"the matrix and the geometry mark different {grid.elements} as valid")


def _evaluate_images(
    bench: Bench, record: LoopRecord, seconds: float, model_psf: NDArray[np.float32] | None
) -> tuple[NDArray[np.float32], StrehlEstimate | None, list[str]]:
    """Images of the science camera, the Strehl ratios where there are any, and what to know about the run."""
    notes = ["the loop diverged and was opened"] if record.diverged else []
    images = record.science.images()
    if bench.science is None or model_psf is None:
        return images, None, notes
    notes += _collect_science_notes(bench, bench.science, record, seconds)
    if record.diverged or not record.science.count:
        return images, None, notes
    try:
        return images, strehl(images, model_psf), notes
    except CalibrationError as error:
        return images, None, [*notes, f"no Strehl ratio: {error}"]


def _collect_science_notes(bench: Bench, science: Camera, record: LoopRecord, seconds: float) -> list[str]:
    """What to know about the science frames of a run, or about their lack."""
    rate, count = science.settings.frame_rate_hz, record.science.count
    # The first frame or two after closing do not count.
    expected = int((seconds - SETTLING_S) * rate) - 2
    notes = []
    if record.science.clipped:
        notes.append(
            f"the image's peak is saturated in {record.science.clipped} of {count} frames of {science.name}: "
            "the Strehl ratios are too low; expose for a shorter time"
        )
    if count < expected / 2:
        notes.append(f"only {count} of about {expected} frames came from {science.name}")
    if count < MIN_SAMPLES and not record.diverged:
        needed = minimum_strehl_frames(bench.wfs.settings.frame_rate_hz, rate)
        missing = "an error of the Strehl ratios" if count else "Strehl ratios"
        notes.append(
            f"too short for {missing}: {count} frames of {science.name} after the {SETTLING_S:g} s in which "
            f"the loop closes; run it for at least {needed} frames"
        )
    return notes


def _subtract_background(image: NDArray[np.floating]) -> NDArray[np.float32]:
    return subtract_background(image).astype(np.float32)


def is_steady(residual: NDArray[np.float32]) -> bool:
    """False when the residual grows towards the end: the last third against the middle one."""
    third = residual.size // 3
    if third < 20:
        return bool(np.isfinite(residual).all())
    middle, last = np.median(residual[third : 2 * third]), np.median(residual[2 * third :])
    return bool(np.isfinite(residual).all() and last < 2.0 * middle)


def select_settled_residual(record: LoopRecord, rate_hz: float) -> NDArray[np.float32]:
    """Residuals ``(n,)`` in nanometres since the loop has been closed for :data:`SETTLING_S`."""
    return np.array(record.residual[int(SETTLING_S * rate_hz) :], np.float32)


def collect_loop_notes(record: LoopRecord, rate_hz: float) -> list[str]:
    """What to know of a loop that was poked, for whoever uses what the pokes told."""
    notes = []
    if not is_steady(select_settled_residual(record, rate_hz)):
        notes.append("the loop's residual grew to the end; was it about to diverge? Lower loop.gain")
    shortened = record.shortened / max(record.frames, 1)
    if shortened > 0.01:
        notes.append(
            f"the mirror's limits shortened {shortened:.0%} of the commands, pokes with them; they are "
            "accounted for, and cost signal: lower the pokes, or the turbulence is more than the mirror takes"
        )
    return notes


def latency_percentiles(latency_ns: Sequence[int]) -> dict[str, float]:
    """Median, 99th percentile and largest of the latencies, in microseconds."""
    if not latency_ns:
        return {"p50": math.nan, "p99": math.nan, "max": math.nan}
    p50, p99, worst = np.percentile(np.array(latency_ns) / 1e3, [50, 99, 100])
    return {"p50": float(p50), "p99": float(p99), "max": float(worst)}
