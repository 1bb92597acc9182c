"""Closing the loop with a matrix, and judging it."""

from __future__ import annotations

import math
import time
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.camera import Camera
from escape_hw.api.frames import Frame
from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import LoopResult, StrehlEstimate
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import LightWatch, next_frame, some_frames
from escape_hw.calibration.sensor_setup import extractor, prepare_sensor
from escape_hw.errors import Aborted, CalibrationError, ConfigError, IncompatibleProduct
from escape_hw.pipeline.design_psf import design_psf
from escape_hw.pipeline.frame_stack import FrameStack
from escape_hw.pipeline.integrator import LeakyIntegrator, gain_limit
from escape_hw.pipeline.reconstructor import reconstructor
from escape_hw.pipeline.standard_error import LEAST
from escape_hw.pipeline.strehl import has_light, strehl, without_background

#: Seconds after closing during which the science frames do not count.
_CLOSING_S = 0.3
#: The loop counts as diverging when this share of the actuators stays clipped ...
_SATURATED = 0.2
#: ... for this many frames in a row.
_SATURATED_FRAMES = 50
#: Shares of the stable limit that the search for the best gain tries.
GAIN_SHARES = (0.25, 0.35, 0.45, 0.55, 0.65, 0.75)
#: Gains tried beyond those while the loop gets better and better, each this much above the last.
_MORE_GAINS, _MORE_STEP = 4, 1.2
#: Delay assumed for the gain's limit when the matrix does not carry a measured one.
_USUAL_DELAY = 2.0


@dataclass(slots=True, eq=False)
class _Record:
    """What a run gathers on its way."""

    science: FrameStack = field(default_factory=FrameStack)
    residual: list[float] = field(default_factory=list)
    latency: list[int] = field(default_factory=list)
    frames: int = 0
    diverged: bool = False
    last: Frame | None = None
    command: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))


def measure_model_psf(bench: Bench, *, frames: int = 20) -> Procedure[NDArray[np.float32]]:
    """Mean PSF with a flat mirror and no turbulence in the beam (paper: the empirical model).

    Under a sky that cannot be switched off (``devices.science.model_psf = "design"``) it is the
    diffraction image of the design's pupil, and no frame is taken.

    Raises
    ------
    CalibrationError
        The system has no science camera, or it sees no light.
    """
    some_frames(frames)
    science = bench.science
    if science is None:
        raise CalibrationError("this system has no science camera to take a PSF with")
    config = bench.config.devices.science
    if config is not None and config.model_psf == "design":
        _, pupil, pixel_m = bench.model().influence_functions()
        across = bench.config.system.pupil_m / pixel_m
        return design_psf(pupil, across, config.psf_px, (config.region[3], config.region[2]))
    bench.dm.flatten()
    science.stop()
    wait = bench.config.devices.science.timeout_s if bench.config.devices.science else 1.0
    report = Reporter("model PSF", frames)
    science.next_frame(wait)
    total = np.zeros((), np.float64)
    try:
        for done in range(frames):
            total = total + science.next_frame(wait).data
            if report.due():
                yield report(done + 1)
    finally:
        science.stop()
    image = _clean(total / frames)
    if not has_light(image):
        raise CalibrationError(
            f"{science.name}: no light on the science camera; check the source, the beam stop and the region"
        )
    return image


def closed_loop(
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
    c = bench.config.loop
    gain = c.gain if gain is None else gain
    leak = c.leak if leak is None else leak
    dropped = c.dropped_modes if dropped_modes is None else dropped_modes
    some_frames(frames)
    if not (0 < gain < math.inf and 0 <= leak <= 1):
        raise ConfigError(f"gain is {gain} and leak {leak}; the gain must be positive, the leak in [0, 1]")
    _require_fit(bench, matrix, grid)
    stroke = np.sqrt(np.mean(np.square(matrix.m2c), axis=0))
    control = LeakyIntegrator(reconstructor(matrix.data, scale=stroke, dropped_modes=dropped), gain, leak)
    prepare_sensor(bench)
    slopes_of = extractor(bench, grid)
    record, partial = _Record(), False
    science = bench.science if model_psf is not None else None
    bench.dm.flatten()
    # One frame first: what the camera lost while nobody read it is not a loss of the loop.
    next_frame(bench)
    lost, started = bench.wfs.status().lost, bench.wfs.now_ns()
    if science is not None:
        science.stop()
    try:
        yield from _run(bench, matrix, slopes_of, control, frames, science is not None, record, stage)
    except Aborted:
        partial = True
    finally:
        bench.dm.flatten()
        if science is not None:
            science.stop()
    seconds = max((bench.wfs.now_ns() - started) * 1e-9, 1e-9)
    images, ratio, notes = _judged(bench, record, seconds, model_psf)
    residual = np.array(record.residual, dtype=np.float32)
    settled = residual[len(residual) // 10 :]
    return LoopResult(
        method=matrix.method, gain=gain, leak=leak, dropped_modes=dropped, frames=record.frames,
        lost_frames=bench.wfs.status().lost - lost, rate_hz=record.frames / seconds,
        stable=not record.diverged and _steady(residual),
        residual_rms_nm=float(np.sqrt(np.mean(np.square(settled)))) if settled.size else math.nan,
        strehl=ratio, latency_us=_percentiles(record.latency),
        psf=_clean(images.mean(axis=0)) if len(images) else None,
        model_psf=model_psf, residual_nm=residual[:: max(1, residual.size // 2000)],
        last_command=record.command, last_frame=None if record.last is None else record.last.data,
        partial=partial, notes=tuple(notes),
    )  # fmt: skip


def _require_fit(bench: Bench, matrix: InteractionMatrix, grid: SensorGeometry) -> None:
    """Raise :class:`IncompatibleProduct` unless mirror, matrix and grid belong together."""
    if matrix.m2c.shape[0] != bench.dm.info.n_act or matrix.n_slopes != grid.n_slopes:
        raise IncompatibleProduct(
            f"the matrix is for {matrix.m2c.shape[0]} actuators and {matrix.n_slopes} slopes; "
            f"this bench has {bench.dm.info.n_act} and {grid.n_slopes}"
        )
    if not np.array_equal(matrix.valid, grid.valid):
        raise IncompatibleProduct(f"the matrix and the geometry mark different {grid.elements} as valid")


def _judged(
    bench: Bench, record: _Record, seconds: float, model_psf: NDArray[np.float32] | None
) -> tuple[NDArray[np.float32], StrehlEstimate | None, list[str]]:
    """Images of the science camera, the Strehl ratios where there are any, and what to know about the run."""
    notes = ["the loop diverged and was opened"] if record.diverged else []
    images = record.science.images()
    if bench.science is None or model_psf is None:
        return images, None, notes
    notes += _science_notes(bench, bench.science, record, seconds)
    if record.diverged or not record.science.count:
        return images, None, notes
    try:
        return images, strehl(images, model_psf), notes
    except CalibrationError as error:
        return images, None, [*notes, f"no Strehl ratio: {error}"]


def _run(
    bench: Bench,
    matrix: InteractionMatrix,
    slopes_of: SlopeFunction,
    control: LeakyIntegrator,
    frames: int,
    watch: bool,
    record: _Record,
    stage: str,
) -> Procedure[None]:
    light = LightWatch(bench.wfs.name, slopes_of.grid)
    to_modes = np.linalg.pinv(matrix.m2c)
    # Reflection doubles the surface; modes have unit rms surface.
    metres = 2 * bench.dm.info.stroke_m
    closing = int(_CLOSING_S * bench.wfs.settings.frame_rate_hz)
    report = Reporter(stage, frames)
    saturated = 0
    for done in range(frames):
        frame = next_frame(bench)
        began = time.perf_counter_ns()
        modes = control(slopes_of(frame.data))
        sent = bench.dm.send(matrix.m2c @ modes)
        record.latency.append(time.perf_counter_ns() - began)
        light(slopes_of.flux)
        if not sent.guard.untouched:
            control.applied(to_modes @ sent.sent)
        record.frames, record.last, record.command = done + 1, frame, sent.sent
        record.residual.append(metres * 1e9 * float(np.linalg.norm(control.residual)))
        saturated = saturated + 1 if sent.guard.clipped > _SATURATED * sent.sent.size else 0
        if saturated >= _SATURATED_FRAMES:
            record.diverged = True
            return
        if watch and done >= closing and bench.science is not None:
            image = bench.science.poll()
            if image is not None and done > closing + 1:
                record.science.add(image.data)
        if report.due():
            yield report(done + 1, residual_nm=record.residual[-1], gain=float(control.gain))


def _science_notes(bench: Bench, science: Camera, record: _Record, seconds: float) -> list[str]:
    """What to know about the science frames of a run, or about their lack."""
    rate, count = science.settings.frame_rate_hz, record.science.count
    # The first frame or two after closing do not count.
    expected = int((seconds - _CLOSING_S) * rate) - 2
    notes = []
    if count < expected / 2:
        notes.append(f"only {count} of about {expected} frames came from {science.name}")
    if count < LEAST and not record.diverged:
        needed = math.ceil((_CLOSING_S + (LEAST + 2) / rate) * bench.wfs.settings.frame_rate_hz)
        missing = "an error of the Strehl ratios" if count else "Strehl ratios"
        notes.append(
            f"too short for {missing}: {count} frames of {science.name} after the {_CLOSING_S:g} s in which "
            f"the loop closes; run it for at least {needed} frames"
        )
    return notes


def _clean(image: NDArray[np.floating]) -> NDArray[np.float32]:
    return without_background(image).astype(np.float32)


def _steady(residual: NDArray[np.float32]) -> bool:
    """False when the residual grows towards the end: the last third against the middle one."""
    third = residual.size // 3
    if third < 20:
        return bool(np.isfinite(residual).all())
    middle, last = np.median(residual[third : 2 * third]), np.median(residual[2 * third :])
    return bool(np.isfinite(residual).all() and last < 2.0 * middle)


def _percentiles(latency_ns: list[int]) -> dict[str, float]:
    if not latency_ns:
        return {"p50": math.nan, "p99": math.nan, "max": math.nan}
    p50, p99, worst = np.percentile(np.array(latency_ns) / 1e3, [50, 99, 100])
    return {"p50": float(p50), "p99": float(p99), "max": float(worst)}


def best_gain(
    bench: Bench,
    matrix: InteractionMatrix,
    grid: SensorGeometry,
    *,
    gains: tuple[float, ...] | None = None,
    frames: int = 1500,
    model_psf: NDArray[np.float32] | None = None,
) -> Procedure[tuple[float, list[LoopResult]]]:
    """The gain with the least residual (or the highest Strehl ratio, given a model PSF).

    Parameters
    ----------
    bench, matrix, grid
        As for :func:`closed_loop`.
    gains
        Gains to try; by default shares of the largest stable one for the delay that was measured
        with the matrix.
    frames
        Frames per gain.
    model_psf
        With it, gains are judged by the Strehl ratio.

    Raises
    ------
    CalibrationError
        No gain gives a stable loop.
    """
    delay = float(matrix.metrics.get("delay_frames", _USUAL_DELAY))
    waiting = list(gains or (share * gain_limit(delay) for share in GAIN_SHARES))
    more = 0 if gains else _MORE_GAINS
    runs: list[LoopResult] = []
    while waiting:
        gain = waiting.pop(0)
        run = yield from closed_loop(
            bench,
            matrix,
            grid,
            gain=gain,
            frames=frames,
            model_psf=model_psf,
            stage=f"loop at gain {gain:.2f}",
        )
        runs.append(run)
        if run.partial:
            return gain, runs
        if sum(not r.stable for r in runs) > 1:
            break
        if not waiting and more and _rises_to_its_end(runs):
            # The top is not passed yet: a best gain at the edge of the scan is none.
            waiting, more = [gain * _MORE_STEP], more - 1
    stable = [run for run in runs if run.stable]
    if not stable:
        raise CalibrationError(
            f"the loop closes at none of the gains {', '.join(f'{r.gain:.2f}' for r in runs)}; "
            "drop more modes or measure the matrix again"
        )
    return _peak(stable), runs


def _rises_to_its_end(runs: list[LoopResult]) -> bool:
    """Whether every loop was stable and the last gain is the best so far."""
    return all(run.stable for run in runs) and int(np.argmax(_merits(runs))) == len(runs) - 1


def _peak(runs: list[LoopResult]) -> float:
    """Gain at the top of a parabola through the merits, so that one lucky run does not decide.

    With fewer than four runs, or where the parabola has no top, the best run's gain.
    """
    gains = np.array([run.gain for run in runs])
    merits = _merits(runs)
    best = float(gains[int(np.argmax(merits))])
    if gains.size < 4:
        return best
    bend, slope, _ = np.polyfit(gains, merits, 2)
    if bend >= 0:
        return best
    return float(np.clip(-slope / (2 * bend), gains.min(), gains.max()))


def _merits(runs: list[LoopResult]) -> NDArray[np.float64]:
    """Strehl ratios, or (as soon as one run has none) residuals: never one beside the other."""
    ratios = [run.strehl.peak.value for run in runs if run.strehl is not None]
    return np.array(ratios if len(ratios) == len(runs) else [-run.residual_rms_nm for run in runs])
