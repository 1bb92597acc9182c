"""DO-CRIME in open loop: random pokes on every mode, under turbulence (paper; Lai et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.brief import brief
from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import (
    measured_matrix,
    some_frames,
)
from escape_hw.calibration.checkpoint import Checkpoint
from escape_hw.calibration.docrime_estimator import DocrimeEstimator
from escape_hw.calibration.docrime_solution import DocrimeSolution
from escape_hw.calibration.poke_patterns import Pattern, RandomPokes, random_pattern
from escape_hw.calibration.poke_session import PokeSession, Record
from escape_hw.calibration.sensor_setup import (
    SETUP_FRAMES,
    modal_basis,
    random_amplitudes,
)
from escape_hw.calibration.stopping import Judge, Looks, Target, no_accuracy
from escape_hw.config.models import CalibrationSection
from escape_hw.errors import Aborted, TooFewFrames

#: Slopes up to which the correlation of their noise is followed.
MOST_CORRELATED = 3000
#: Share of the response in its last frame beyond which one may doubt that it ends there.
_TAIL = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeRun:
    """A DO-CRIME run: the calibration, and the solution it came from.

    ``record`` holds, when it was asked for, the frame indices ``(n,)``, slopes ``(n, n_slopes)`` and
    pokes ``(n, n_modes)``.
    """

    result: CalibrationResult
    solution: DocrimeSolution
    record: Record | None = None
    __repr__ = brief


def docrime_run(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    whiten: bool = True,
    grid: SensorGeometry | None = None,
    record: bool = False,
    correlations: bool = True,
    pattern: type[Pattern] = RandomPokes,
    keep: Checkpoint | None = None,
    judge: Judge | None = None,
) -> Procedure[DocrimeRun]:
    """As :func:`docrime`, with the solution beside the matrix, and with the telemetry if asked for.

    The solution knows how the noise of the slopes is correlated unless ``correlations`` is false, or
    there are more than :data:`MOST_CORRELATED` slopes. ``pattern`` makes the pokes, ``judge`` says
    when a solution will do.
    """
    c = bench.config.calibration
    n_frames = c.frames if frames is None else some_frames(frames)
    poke = c.poke if poke is None else poke
    pattern = random_pattern(c.pokes) if pattern is RandomPokes else pattern
    m2c = modal_basis(bench)
    amplitude = random_amplitudes(bench, m2c, poke)
    require_frames(c, n_frames, m2c.shape[1], whiten)
    order, lags = c.whiten_order if whiten else 0, c.lags

    def estimator(n_slopes: int) -> DocrimeEstimator:
        # Their number squared: with as many slopes as a pyramid has, gigabytes.
        known = correlations and n_slopes <= MOST_CORRELATED
        return DocrimeEstimator(n_slopes, m2c.shape[1], order=order, lags=lags, correlations=known)

    session = PokeSession(
        bench, m2c, grid, min(SETUP_FRAMES, n_frames), estimator, keep=record, looks=Looks(keep, judge)
    )
    settings = {"poke": poke, "whiten": whiten, "correlations": correlations}
    state = None if keep is None else keep.begin(bench, pattern.method, m2c, settings)
    if state is not None:
        session.restore(state)
    partial = yield from session.poke(n_frames, pattern(amplitude, bench.rng), pattern.title)
    session.ready()
    if session.estimator is None or session.grid is None or session.motion is None:
        raise Aborted("aborted before the first frames")
    try:
        solution = session.estimator.solve()
    except TooFewFrames:
        if partial:
            raise Aborted(f"aborted after {session.taken} frames, too few for a matrix") from None
        raise
    method = pattern.method + ("-whitened" if whiten and issubclass(pattern, RandomPokes) else "")
    matrix = matrix_of(
        bench, session.grid, m2c, solution, method, poke=float(poke), shortened=session.shortened
    )
    return DocrimeRun(_result(session, matrix, solution, partial), solution, session.record())


def matrix_of(
    bench: Bench,
    grid: SensorGeometry,
    m2c: NDArray[np.float64],
    solution: DocrimeSolution,
    method: str,
    **metrics: float | int | str,
) -> InteractionMatrix:
    """The matrix of a solution with its provenance and metrics."""
    return measured_matrix(
        bench, grid, m2c, solution.matrix, solution.sigma, method,
        frames=solution.frames, lost_frames=solution.lost_frames, delay_frames=solution.response.delay,
        whitening_order=solution.whitener.size - 1, gain_sigma=solution.gain_sigma, **metrics,
    )  # fmt: skip


def notes_on(solution: DocrimeSolution, matrix: InteractionMatrix) -> list[str]:
    """What to know of a solution before using it."""
    notes = []
    if float(np.median(matrix.snr())) < 1:
        notes.append("the median mode has a signal-to-noise ratio below 1; use more frames or larger pokes")
    tail, error = solution.response.weights[-1], solution.response.sigma[-1]
    if abs(tail) > max(_TAIL, 4 * error):
        notes.append(
            f"{tail:.0%} of the response come only {solution.response.weights.size - 1} frames after a "
            "command, so some may come later still, which scales the matrix; raise calibration.lags"
        )
    return notes


def snr_judge(bench: Bench, m2c: NDArray[np.float64], until: Target | None, method: str) -> Judge | None:
    """Judges a solution by the signal-to-noise ratio asked for; ``None`` when none is.

    Raises
    ------
    ConfigError
        A registration's accuracy is asked for, too: a matrix alone has none.
    """
    no_accuracy(until)
    if until is None:
        return None

    def judge(solution: DocrimeSolution, grid: SensorGeometry) -> Procedure[bool]:
        yield from ()
        return until.snr_met(matrix_of(bench, grid, m2c, solution, method))

    return judge


def _result(
    session: PokeSession, matrix: InteractionMatrix, solution: DocrimeSolution, partial: bool
) -> CalibrationResult:
    """The matrix with all that the run taught about the sensor."""
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
        notes=(*notes_on(solution, matrix), *session.notes()),
    )


def docrime(
    bench: Bench,
    *,
    frames: int | None = None,
    poke: float | None = None,
    whiten: bool = True,
    grid: SensorGeometry | None = None,
    pattern: type[Pattern] = RandomPokes,
    until: Target | None = None,
    keep: Checkpoint | None = None,
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
    pattern
        Other pokes than random ones: :class:`~escape_hw.calibration.poke_patterns.PushPullPokes` make it
        a fast push-pull.
    until
        Stop before that number of frames when this is reached.
    keep
        Where the state is kept meanwhile, and what to go on with.

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
    ProductError
        The state to go on with is damaged or of another run; nothing moved.
    Aborted
        Stopped before a matrix could be solved.
    """
    judge = None if until is None else snr_judge(bench, modal_basis(bench), until, pattern.method)
    # Nobody asks a matrix how the noise of its slopes is correlated.
    run = yield from docrime_run(
        bench, frames=frames, poke=poke, whiten=whiten, grid=grid, correlations=False, pattern=pattern,
        keep=keep, judge=judge,
    )  # fmt: skip
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
