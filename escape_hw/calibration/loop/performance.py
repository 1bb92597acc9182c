"""Closed-loop run of a given number of frames, and its performance: residual, Strehl ratios, latency."""

from __future__ import annotations

import logging
import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Camera
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import Estimate, LoopResult, StrehlEstimate
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.frames import validate_frame_count
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.divergence import is_steady
from escape_hw.calibration.loop.runner import SETTLING_S, LoopRecord, RunningLoop, minimum_strehl_frames
from escape_hw.errors import Aborted, CalibrationError
from escape_hw.pipeline.psf.frame_stack import FrameStack
from escape_hw.pipeline.psf.strehl import strehl, subtract_background
from escape_hw.pipeline.statistics import MIN_SAMPLES, root_mean_square

log = logging.getLogger(__name__)


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
    matrix, grid
        Interaction matrix, and the sensor geometry that it was measured on.
    gain, leak, dropped_modes
        Loop parameters; by default as configured.
    frames
        Number of frames.
    model_psf
        PSF without turbulence ``(rows, columns)``. With it and a science camera Strehl ratios are measured.
    stage
        Name of the stage in progress reports.

    Returns
    -------
    LoopResult
        ``stable`` is false if the loop was opened because it diverged, or its residual grew to the end.

    Raises
    ------
    ConfigError
        A gain, leak or number of frames is out of range; nothing moved.
    IncompatibleProduct
        The matrix belongs to another mirror, geometry or camera region; nothing moved.
    CalibrationError
        The matrix cannot be inverted, or the sensor went dark.
    """
    validate_frame_count(frames)
    control = build_integrator(bench, matrix, grid, gain=gain, leak=leak, dropped_modes=dropped_modes)
    c = bench.config.loop
    loop = RunningLoop.prepare(bench, matrix, grid, control, science=model_psf is not None)
    record, partial = loop.record, False
    with loop.closed():
        try:
            yield from loop.run(frames, report=Reporter(stage, frames))
        except Aborted:
            partial = True
    seconds = max(loop.elapsed_s, 1e-9)
    images, ratio, notes = _evaluate_images(bench, record, seconds, model_psf)
    residual = np.array(record.residual, dtype=np.float32)
    settled = residual[len(residual) // 10 :]
    return LoopResult(
        method=matrix.method, gain=c.gain if gain is None else gain, leak=c.leak if leak is None else leak,
        dropped_modes=c.dropped_modes if dropped_modes is None else dropped_modes, frames=record.frames,
        lost_frames=loop.lost_frames, rate_hz=record.frames / seconds,
        stable=not record.diverged and is_steady(residual),
        residual_rms_nm=root_mean_square(settled),
        strehl=ratio, latency_us=latency_percentiles(record.latency),
        psf=subtract_background(images.mean(axis=0)).astype(np.float32) if len(images) else None,
        model_psf=model_psf, residual_nm=residual[:: max(1, residual.size // 2000)],
        last_command=record.command, last_frame=None if record.last is None else record.last.data,
        partial=partial, notes=tuple(notes),
    )  # fmt: skip


def _evaluate_images(
    bench: Bench, record: LoopRecord, seconds: float, model_psf: NDArray[np.float32] | None
) -> tuple[NDArray[np.float32], StrehlEstimate | None, list[str]]:
    """Images of the science camera, their Strehl ratios if there are any, and notes on the run."""
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


def peak_strehl(images: FrameStack, model_psf: NDArray[np.float32]) -> Estimate | None:
    """Strehl ratio of the peak; ``None``, with a line in the log, if the images are dark or not centred."""
    try:
        return strehl(images.images(), model_psf).peak
    except CalibrationError as error:
        log.warning("no Strehl ratio: %s", error)
        return None


def _collect_science_notes(bench: Bench, science: Camera, record: LoopRecord, seconds: float) -> list[str]:
    """Notes on missing or saturated science frames of a run."""
    rate, count = science.settings.frame_rate_hz, record.science.count
    # The first two frames after settling do not count.
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
            f"the loop settles; run it for at least {needed} frames"
        )
    return notes


def select_settled_residual(record: LoopRecord, rate_hz: float) -> NDArray[np.float32]:
    """Residuals ``(n,)`` in nm of the frames after the loop has settled."""
    return np.array(record.residual[int(SETTLING_S * rate_hz) :], np.float32)


def collect_loop_notes(record: LoopRecord, rate_hz: float) -> list[str]:
    """Notes on a loop with pokes that qualify what was measured with the pokes."""
    notes = []
    if not is_steady(select_settled_residual(record, rate_hz)):
        notes.append(
            "the loop's residual grew towards the end; the loop may have been diverging: lower loop.gain"
        )
    shortened = record.shortened / max(record.frames, 1)
    if shortened > 0.01:
        notes.append(
            f"the mirror's limits shortened {shortened:.0%} of the commands and the pokes in them. The "
            "estimate accounts for this but loses signal: lower the pokes, or calibrate in weaker turbulence"
        )
    return notes


def latency_percentiles(latency_ns: Sequence[int]) -> dict[str, float]:
    """Median, 99th percentile and maximum of latencies, in microseconds; NaN without any."""
    if not latency_ns:
        return {"p50": math.nan, "p99": math.nan, "max": math.nan}
    p50, p99, largest = np.percentile(np.array(latency_ns) / 1e3, [50, 99, 100])
    return {"p50": float(p50), "p99": float(p99), "max": float(largest)}
