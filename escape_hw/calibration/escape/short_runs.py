"""ESCAPE from fewer frames than an interaction matrix takes, in open and in closed loop.

Such a run lasts less than a second. It cannot be resumed; an aborted one is discarded.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.aligned_telemetry import TelemetryBuffer
from escape_hw.calibration.acquisition.frames import (
    build_interaction_matrix,
    validate_frame_count,
)
from escape_hw.calibration.acquisition.pokes import (
    compute_random_amplitudes,
    note_limited_poke,
    select_random_pokes,
)
from escape_hw.calibration.acquisition.sensor_setup import SETUP_FRAMES
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics
from escape_hw.calibration.docrime.acquisition import AcquisitionRecord, OpenLoopAcquisition
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.divergence import require_not_diverged
from escape_hw.calibration.loop.performance import collect_loop_notes
from escape_hw.calibration.loop.runner import RunningLoop
from escape_hw.calibration.modes.bases import build_modal_basis
from escape_hw.calibration.sprint.fit import sprint_options_from_config
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_jacobian, synthesise_calibration
from escape_hw.calibration.sprint.telemetry_fit import (
    MIN_WHITENED_FRAMES,
    TelemetryFit,
    fit_telemetry,
    telemetry_from_frames,
)
from escape_hw.config.system import CalibrationSection
from escape_hw.errors import Aborted, TooFewFrames

_NOTE = "too few frames for a measured matrix: the registration was fitted to the telemetry"
#: Frames per past frame of the whitening filter, so that there are enough to estimate it.
_FRAMES_PER_ORDER = 3


def calibrate_short_run(
    bench: Bench, *, frames: int, poke: float | None = None, grid: SensorGeometry | None = None
) -> Procedure[CalibrationResult]:
    """Fit the registration to the telemetry of a few frames in open loop, and synthesise the matrix.

    ``frames``: number of frames; the geometry of the sensor is found on them as well, unless ``grid`` is
    given; ``poke``: pokes are uniform in +-poke on every mode, rms surface as fraction of full stroke.

    The result has no measured matrix.

    Raises
    ------
    TooFewFrames
        Too few frames for an estimate of the noise; nothing moved.
    CalibrationError
        No spots or pupil images, no light, or no response.
    Aborted
        Stopped before the last frame.
    """
    c = bench.config.calibration
    order, poke = choose_whitening_order(c, frames), c.poke if poke is None else poke
    m2c = build_modal_basis(bench)
    amplitude = compute_random_amplitudes(bench, m2c, poke)
    acquisition = OpenLoopAcquisition(bench, m2c, grid, min(SETUP_FRAMES, frames), None, store_samples=True)
    if (yield from acquisition.poke(frames, select_random_pokes(c.pokes)(amplitude, bench.rng))):
        raise Aborted(
            f"aborted after {acquisition.n_received} of {frames} frames, too few for a registration"
        )
    sensor, record = acquisition.sensor, acquisition.record()
    if record is None:
        raise RuntimeError("no frame was taken")
    # The lattice of a Shack-Hartmann was fitted to the mean spots of these frames; the pupil images of a
    # pyramid are located best on all frames.
    geometry = (
        acquisition.build_final_geometry()
        if acquisition.uses_run_mean
        else sensor.statistics.annotate_geometry(sensor.grid)
    )
    shape = (geometry.n_slopes, m2c.shape[1])
    template = build_interaction_matrix(bench, geometry, m2c, np.zeros(shape), np.zeros(shape), "telemetry")
    model = bench.model(geometry)
    fit = yield from fit_recorded_frames(bench, record, template, model, order)
    n_frames = int(record[0].size)
    result = _build_result(
        bench, fit, geometry, model, m2c, frames=n_frames,
        lost=int(record[0][-1] - record[0][0]) + 1 - n_frames, amplitude=amplitude, poke=poke, order=order,
        shortened=acquisition.shortened,
    )  # fmt: skip
    return replace(
        result,
        grid=acquisition.build_final_geometry(),
        mean_frame=sensor.mean_frame,
        notes=(*result.notes, *acquisition.notes()),
    )


def fit_recorded_frames(
    bench: Bench, record: AcquisitionRecord, template: InteractionMatrix, model: SyntheticModel, order: int
) -> Procedure[TelemetryFit]:
    """Fit the registration to the frames of an open-loop run.

    ``template``, ``model``: a matrix of this sensor and basis, whose data are not used, and its model.
    """
    c = bench.config.calibration
    data = telemetry_from_frames(*record, before=2 * c.whiten_order + c.lags)
    options = sprint_options_from_config(c)
    fit = fit_telemetry(data, template, model, order=order, lags=c.lags, options=options)
    return (yield from fit)


def choose_whitening_order(c: CalibrationSection, frames: int) -> int:
    """Order of the whitening filter for a number of frames; raises :class:`TooFewFrames`."""
    order = min(c.whiten_order, max(1, validate_frame_count(frames) // _FRAMES_PER_ORDER))
    least = MIN_WHITENED_FRAMES + min(order, 1)
    if frames < least:
        raise TooFewFrames(f"{frames} frames are too few for a registration; ask for at least {least} frames")
    return order


def _build_result(
    bench: Bench,
    fit: TelemetryFit,
    grid: SensorGeometry,
    model: SyntheticModel,
    m2c: NDArray[np.float64],
    *,
    frames: int,
    lost: int,
    amplitude: NDArray[np.float64],
    poke: float,
    order: int,
    shortened: int,
) -> CalibrationResult:
    """Calibration with the pseudo-synthetic matrix of a fit.

    ``amplitude``: poke of each mode ``(n_modes,)``; ``poke``: as requested; ``shortened``: number of limited
    commands.
    """
    fitted = compute_fitted_jacobian(model, fit.estimate, m2c)
    synthetic = synthesise_calibration(bench, grid, fit.estimate, m2c, fitted)
    metrics = {
        **synthetic.matrix.metrics, "frames": frames, "lost_frames": lost, "poke": float(amplitude.max()),
        "clipped_pokes": shortened, "delay_frames": fit.response.delay_frames, "whitening_order": order,
    }  # fmt: skip
    return replace(
        synthetic,
        matrix=replace(synthetic.matrix, metrics=metrics),
        frames=frames,
        lost_frames=lost,
        sky_seconds=(frames + lost) / bench.wfs.settings.frame_rate_hz,
        response=fit.response,
        notes=(
            *fit.estimate.warnings,
            *fit.estimate.notes,
            _NOTE,
            *note_limited_poke(bench, amplitude, poke),
        ),
    )


def calibrate_short_run_closed_loop(
    bench: Bench, closed_loop: CalibrationResult, *, frames: int, poke: float | None = None
) -> Procedure[CalibrationResult]:
    """Fit the registration to the telemetry of a few frames of a closed loop, and synthesise the matrix.

    Parameters and result as for :func:`calibrate_short_run`, except:

    ``closed_loop``: calibration whose matrix closes the loop, on whose grid the result is; ``frames``: number
    of frames with pokes, without those in which the loop settles.

    Raises
    ------
    TooFewFrames, Aborted
        As for :func:`calibrate_short_run`.
    IncompatibleProduct
        The matrix belongs to another mirror, grid or camera region; nothing moved.
    CalibrationError
        The loop diverged, the sensor went dark, or it does not respond to the pokes.
    """
    c = bench.config.calibration
    order, poke = choose_whitening_order(c, frames), c.poke if poke is None else poke
    control = build_integrator(bench, closed_loop.matrix, closed_loop.grid)
    loop = RunningLoop.prepare(bench, closed_loop.matrix, closed_loop.grid, control)
    past = 2 * c.whiten_order + c.lags
    buffer = TelemetryBuffer(closed_loop.grid.n_slopes, closed_loop.matrix.n_modes, past + frames, past)
    slope_statistics = SlopeStatistics(closed_loop.grid.n_slopes)
    amplitude = compute_random_amplitudes(bench, loop.m2c, poke)
    yield from _record_frames(loop, frames, amplitude, past, buffer, slope_statistics)
    geometry = slope_statistics.annotate_geometry(closed_loop.grid, closed=True)
    data, _ = buffer.take_block()
    # Slopes without known commands of all lags and filters count as lost.
    unknown = slice(c.whiten_order + c.lags)
    data.present[unknown], data.slopes[unknown] = False, 0
    registration = closed_loop.registration
    model = bench.model(geometry)
    fit = yield from fit_telemetry(
        data, closed_loop.matrix, model, order=order, lags=c.lags,
        options=sprint_options_from_config(c), known_response=closed_loop.response,
        start=None if registration is None else registration.registration,
    )  # fmt: skip
    result = _build_result(
        bench, fit, geometry, model, closed_loop.matrix.m2c, frames=frames, lost=buffer.lost,
        amplitude=amplitude, poke=poke, order=order, shortened=loop.record.shortened,
    )  # fmt: skip
    notes = collect_loop_notes(loop.record, bench.wfs.settings.frame_rate_hz)
    return replace(result, grid=geometry, notes=(*result.notes, *notes))


def _record_frames(
    loop: RunningLoop,
    frames: int,
    amplitude: NDArray[np.float64],
    past: int,
    buffer: TelemetryBuffer,
    slope_statistics: SlopeStatistics,
) -> Procedure[None]:
    """Close the loop, poke while the telemetry is recorded, and flatten the mirror."""
    bench = loop.bench
    pokes = select_random_pokes(bench.config.calibration.pokes)(amplitude, bench.rng)
    settling_frames = max(loop.settling_frames - past, 0)
    stage = f"{pokes.title} in closed loop"
    with loop.closed():
        try:
            yield from loop.settle(settling_frames)
            yield from loop.settle(past, observe=(buffer,))
            observers = (buffer, lambda _index, slopes, _command, _poke: slope_statistics.add(slopes))
            yield from loop.run(frames, inject=pokes, observe=observers, report=Reporter(stage, frames))
        except Aborted:
            n_frames = settling_frames + past + frames
            raise Aborted(
                f"aborted after {loop.record.frames} of {n_frames} frames, too few for a registration"
            ) from None
    require_not_diverged(loop.record.diverged, loop.record.frames)
