"""DO-CRIME in open loop: random pokes on every mode, under turbulence (paper; Lai et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import (
    measured_matrix,
    some_frames,
)
from escape_hw.calibration.docrime_estimator import DocrimeEstimator, DocrimeSolution
from escape_hw.calibration.poke_session import PokeSession, Record
from escape_hw.calibration.sensor_setup import (
    SETUP_FRAMES,
    modal_basis,
    poke_amplitudes,
)
from escape_hw.config.models import CalibrationSection
from escape_hw.errors import Aborted, TooFewFrames


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeRun:
    """A DO-CRIME run: the calibration, and the solution it came from.

    ``record`` holds, when it was asked for, the frame indices ``(n,)``, slopes ``(n, n_slopes)`` and
    pokes ``(n, n_modes)``.
    """

    result: CalibrationResult
    solution: DocrimeSolution
    record: Record | None = None


def docrime_run(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    whiten: bool = True,
    grid: SensorGeometry | None = None,
    record: bool = False,
    correlations: bool = True,
) -> Procedure[DocrimeRun]:
    """As :func:`docrime`, with the solution beside the matrix, and with the telemetry if asked for.

    The solution knows how the noise of the slopes is correlated unless ``correlations`` is false.
    """
    c = bench.config.calibration
    n_frames = c.frames if frames is None else some_frames(frames)
    poke = c.poke if poke is None else poke
    m2c = modal_basis(bench)
    amplitude = poke_amplitudes(bench, m2c, poke)
    require_frames(c, n_frames, m2c.shape[1], whiten)
    order, lags = c.whiten_order if whiten else 0, c.lags

    def estimator(n_slopes: int) -> DocrimeEstimator:
        return DocrimeEstimator(n_slopes, m2c.shape[1], order=order, lags=lags, correlations=correlations)

    session = PokeSession(bench, m2c, grid, min(SETUP_FRAMES, n_frames), estimator, keep=record)
    partial = yield from session.poke(n_frames, amplitude)
    session.ready()
    if session.estimator is None or session.grid is None or session.motion is None:
        raise Aborted("aborted before the first frames")
    try:
        solution = session.estimator.solve()
    except TooFewFrames:
        if partial:
            raise Aborted(f"aborted after {session.taken} frames, too few for a matrix") from None
        raise
    matrix = measured_matrix(
        bench, session.grid, m2c, solution.matrix, solution.sigma,
        "docrime-whitened" if whiten else "docrime",
        frames=solution.frames, lost_frames=solution.lost_frames, poke=float(poke),
        shortened=session.shortened, delay_frames=solution.response.delay,
        whitening_order=solution.whitener.size - 1, gain_sigma=solution.gain_sigma,
    )  # fmt: skip
    return DocrimeRun(_result(session, matrix, solution, partial), solution, session.record())


def _result(
    session: PokeSession, matrix: InteractionMatrix, solution: DocrimeSolution, partial: bool
) -> CalibrationResult:
    """The matrix with all that the run taught about the sensor."""
    notes = []
    if float(np.median(matrix.snr())) < 1:
        notes.append("the median mode has a signal-to-noise ratio below 1; use more frames or larger pokes")
    notes += session.notes()
    seconds = (solution.frames + solution.lost_frames) / session.bench.wfs.settings.frame_rate_hz
    return CalibrationResult(
        matrix,
        session.finished_grid(),
        solution.frames,
        solution.lost_frames,
        seconds,
        solution.response,
        partial=partial,
        mean_frame=session.mean_frame,
        notes=tuple(notes),
    )


def docrime(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    whiten: bool = True,
    grid: SensorGeometry | None = None,
) -> Procedure[CalibrationResult]:
    """Measure the interaction matrix by random pokes, under turbulence or not.

    The sensor's grid is found on the first frames of the run itself, so it costs no sky time.

    Parameters
    ----------
    bench
        An open bench, loop open.
    frames
        Frames to take; as configured by default.
    poke
        Pokes are uniform in +-poke on every mode, rms surface as fraction of full stroke.
    whiten
        Subtract what the past predicts of the turbulence; false gives the paper's plain estimator.
    grid
        The sensor's grid, when it is known already.

    Returns
    -------
    CalibrationResult
        With the measured temporal response. Stopped early, ``partial`` is true.

    Raises
    ------
    ConfigError
        A number of frames or a poke that means nothing; nothing moved.
    TooFewFrames
        Too few frames for the number of modes; nothing moved.
    CalibrationError
        No spots or pupil images, no light, no response, or pokes that do not span the modes.
    Aborted
        Stopped before a matrix could be solved.
    """
    # Nobody asks a matrix how the noise of its slopes is correlated.
    run = yield from docrime_run(
        bench, frames=frames, poke=poke, whiten=whiten, grid=grid, correlations=False
    )
    return run.result


def least_frames(settings: CalibrationSection, n_modes: int, whiten: bool = True) -> int:
    """Fewest frames that a matrix is worth starting with: twice the unknowns per slope."""
    return 2 * (n_modes + (settings.whiten_order if whiten else 0) + settings.lags)


def require_frames(settings: CalibrationSection, frames: int, n_modes: int, whiten: bool = True) -> None:
    """Raise unless the frames are twice the unknowns per slope.

    Raises
    ------
    TooFewFrames
        Says how many are needed.
    """
    needed = least_frames(settings, n_modes, whiten)
    if frames < needed:
        raise TooFewFrames(
            f"{frames} frames cannot constrain {n_modes} modes; ask for at least {needed} frames, "
            "or for fewer modes (basis.n_modes)"
        )
