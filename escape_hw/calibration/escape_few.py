"""ESCAPE from fewer frames than an interaction matrix takes: a tenth of a second of loop time."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import measured_matrix, some_frames
from escape_hw.calibration.poke_patterns import random_pattern
from escape_hw.calibration.poke_session import PokeSession, Record
from escape_hw.calibration.pseudo_synthetic import synthesise
from escape_hw.calibration.sensor_setup import SETUP_FRAMES, modal_basis, random_amplitudes
from escape_hw.calibration.telemetry_sprint import MIN_ROWS, TelemetryFit, telemetry_sprint, time_line
from escape_hw.config.models import CalibrationSection
from escape_hw.errors import Aborted, TooFewFrames

#: Frames per past frame of the whitening filter, so that there are enough to find it on.
_FRAMES_PER_ORDER = 3


def escape_from_few(
    bench: Bench, *, frames: int, poke: float | None = None, grid: SensorGeometry | None = None
) -> Procedure[CalibrationResult]:
    """Registration straight from the telemetry of a few frames, and the pseudo-synthetic matrix.

    Parameters
    ----------
    bench
        An open bench, loop open.
    frames
        Frames to take; they are also what the sensor's geometry is found on, unless ``grid`` is given.
    poke
        Pokes are uniform in +-poke on every mode, rms surface as fraction of full stroke.
    grid
        The sensor's geometry, when it is known already.

    Returns
    -------
    CalibrationResult
        Without a measured matrix, for which there are too few frames.

    Raises
    ------
    TooFewFrames
        Fewer than a noise level can be told from; nothing moved.
    CalibrationError
        No spots or pupil images, no light, or no response.
    Aborted
        Stopped early; frames this few are worth nothing by halves.
    """
    c = bench.config.calibration
    order, poke = order_for(c, frames), c.poke if poke is None else poke
    m2c = modal_basis(bench)
    amplitude = random_amplitudes(bench, m2c, poke)
    session = PokeSession(bench, m2c, grid, min(SETUP_FRAMES, frames), None, keep=True)
    if (yield from session.poke(frames, random_pattern(c.pokes)(amplitude, bench.rng))):
        raise Aborted(f"aborted after {session.taken} of {frames} frames, too few for a registration")
    session.ready()
    record = session.record()
    if record is None or session.grid is None or session.motion is None:
        raise RuntimeError("no frame was taken")
    # The geometry was found on these very frames, so its lattice is where their mean spots stand. Images of
    # the pupil have places of their own, which all frames tell best.
    found = session.finished_grid() if session.long_look else session.motion.of(session.grid)
    shape = (found.n_slopes, m2c.shape[1])
    frame = measured_matrix(bench, found, m2c, np.zeros(shape), np.zeros(shape), "telemetry")
    fit = yield from fit_record(bench, record, frame, found, order)
    lost = int(record[0][-1] - record[0][0]) + 1 - record[0].size
    result = few_frames_result(
        bench, fit, found, m2c, frames=int(record[0].size), lost=lost, poke=float(poke), order=order,
        shortened=session.shortened,
    )  # fmt: skip
    return replace(
        result,
        grid=session.finished_grid(),
        mean_frame=session.mean_frame,
        notes=(*result.notes, *session.notes()),
    )


def fit_record(
    bench: Bench, record: Record, frame: InteractionMatrix, grid: SensorGeometry, order: int
) -> Procedure[TelemetryFit]:
    """SPRINT on the frames of an open-loop run.

    Parameters
    ----------
    bench
        An open bench.
    record
        Frame indices, slopes and pokes.
    frame
        A matrix of this sensor and basis; its data are not used.
    grid
        The geometry that the model is built on.
    order
        Of the whitening filter.
    """
    c = bench.config.calibration
    data = time_line(*record, before=2 * c.whiten_order + c.lags)
    fit = yield from telemetry_sprint(
        data, frame, bench.model(grid), order=order, lags=c.lags, learning_rate=c.learning_rate,
        solver=c.solver, loss=c.loss, also=c.also, actuators=c.actuators,
    )  # fmt: skip
    return fit


def order_for(c: CalibrationSection, frames: int) -> int:
    """Order of the whitening filter that so many frames can carry.

    Raises
    ------
    TooFewFrames
        Fewer than a noise level can be told from.
    """
    order = min(c.whiten_order, max(1, some_frames(frames) // _FRAMES_PER_ORDER))
    least = MIN_ROWS + min(order, 1)
    if frames < least:
        raise TooFewFrames(f"{frames} frames are too few for a registration; ask for at least {least} frames")
    return order


def few_frames_result(
    bench: Bench,
    fit: TelemetryFit,
    grid: SensorGeometry,
    m2c: NDArray[np.float64],
    *,
    frames: int,
    lost: int,
    poke: float,
    order: int,
    shortened: int,
) -> CalibrationResult:
    """The pseudo-synthetic matrix of a registration that came straight from telemetry.

    Parameters
    ----------
    bench, grid, m2c
        An open bench, the geometry that the model is built on, and the modes ``(n_act, n_modes)``.
    fit
        What the telemetry says.
    frames, lost, poke, order, shortened
        Frames taken and lost, poke (rms surface, fraction of full stroke), order of the whitening filter,
        and commands that the limits cut.
    """
    made = synthesise(bench, grid, fit.estimate, m2c)
    metrics = {
        **made.matrix.metrics, "frames": frames, "lost_frames": lost, "poke": poke,
        "shortened": shortened, "delay_frames": fit.response.delay, "whitening_order": order,
    }  # fmt: skip
    return replace(
        made,
        matrix=replace(made.matrix, metrics=metrics),
        frames=frames,
        lost_frames=lost,
        sky_seconds=(frames + lost) / bench.wfs.settings.frame_rate_hz,
        response=fit.response,
        notes=(
            *fit.estimate.warnings,
            *fit.estimate.notes,
            "too few frames for a measured matrix: the registration comes straight from the telemetry",
        ),
    )
