"""DO-CRIME in open loop: random pokes on every mode, under turbulence (paper; Lai et al. 2020)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.frames import Frame
from escape_hw.api.procedure import Procedure, Reporter
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.bench import Bench
from escape_hw.calibration.acquire import (
    LightWatch,
    Motion,
    measured_matrix,
    next_frame,
    reachable,
    some_frames,
)
from escape_hw.calibration.docrime_estimator import DocrimeEstimator, DocrimeSolution
from escape_hw.calibration.sensor_kinds import kind_of
from escape_hw.calibration.sensor_setup import (
    SETUP_FRAMES,
    extractor,
    modal_basis,
    poke_amplitudes,
    prepare_sensor,
    refined,
    setup_from_frames,
)
from escape_hw.errors import Aborted, TooFewFrames

#: Seconds of turbulence over which what it leaves in the geometry averages out well enough.
_REFERENCE_S = 10.0

Record = tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]


@dataclass(frozen=True, slots=True, eq=False)
class DocrimeRun:
    """A DO-CRIME run: the calibration, and the solution it came from.

    ``record`` holds, when it was asked for, the frame indices ``(n,)``, slopes ``(n, n_slopes)`` and
    pokes ``(n, n_modes)``.
    """

    result: CalibrationResult
    solution: DocrimeSolution
    record: Record | None = None


@dataclass(slots=True, eq=False)
class _Session:
    """State of a run: frames wait until the grid is known, then go straight to the estimator."""

    bench: Bench
    estimator_order: int
    lags: int
    n_modes: int
    grid: SensorGeometry | None
    setup_frames: int
    correlations: bool
    long_look: bool
    mean_frame: NDArray[np.float32] | None = None
    slopes_of: SlopeFunction | None = None
    estimator: DocrimeEstimator | None = None
    motion: Motion | None = None
    light: LightWatch | None = None
    waiting: list[tuple[Frame, NDArray[np.float64]]] = field(default_factory=list)
    taken: int = 0
    looked: NDArray[np.floating] | None = None
    looks: int = 0
    kept: list[tuple[int, NDArray[np.float32], NDArray[np.float64]]] | None = None

    def take(self, frame: Frame, poke: NDArray[np.float64]) -> None:
        self.taken += 1
        if self.estimator is None:
            self.waiting.append((frame, poke))
            if self.grid is not None or len(self.waiting) >= self.setup_frames:
                self.ready()
        else:
            self._feed(frame, poke)

    def ready(self) -> None:
        """Set up the sensor, on the frames that wait if no grid was given, and work them off."""
        if self.estimator is not None or not self.waiting:
            return
        if self.grid is None:
            total = np.zeros(self.waiting[0][0].data.shape)
            for frame, _ in self.waiting:
                total += frame.data
            mean = (total / len(self.waiting)).astype(np.float32)
            setup = setup_from_frames(self.bench, mean)
            self.grid, self.mean_frame = setup.grid, setup.mean_frame
        self.slopes_of = extractor(self.bench, self.grid)
        self.motion, self.light = Motion(self.grid.n_slopes), LightWatch(self.bench.wfs.name, self.grid)
        self.estimator = DocrimeEstimator(
            self.grid.n_slopes,
            self.n_modes,
            order=self.estimator_order,
            lags=self.lags,
            correlations=self.correlations,
        )
        for frame, poke in self.waiting:
            self._feed(frame, poke)
        self.waiting = []

    def finished_grid(self) -> SensorGeometry:
        """The grid with all that the run taught about it; given references stay as they were."""
        if self.grid is None or self.motion is None:
            raise RuntimeError("the sensor was never set up")
        grid = self.motion.of(self.grid)
        if self.mean_frame is None:
            return grid
        if self.looked is not None:
            grid = refined(self.bench, grid, (self.looked / self.looks).astype(np.float32))
        return self.motion.references(grid)

    def _feed(self, frame: Frame, poke: NDArray[np.float64]) -> None:
        if self.slopes_of is None or self.motion is None or self.light is None or self.estimator is None:
            raise RuntimeError("frames were fed before the sensor was set up")
        slopes = self.slopes_of(frame.data)
        self.light(self.slopes_of.flux)
        self.motion.add(slopes)
        if self.long_look:
            self.looked = frame.data + (0.0 if self.looked is None else self.looked)
            self.looks += 1
        self.estimator.partial_fit(frame.index, slopes, poke)
        if self.kept is not None:
            self.kept.append((frame.index, slopes, poke))

    def record(self) -> Record | None:
        if self.kept is None:
            return None
        index, slopes, pokes = zip(*self.kept, strict=True)
        return np.array(index, np.int64), np.stack(slopes), np.stack(pokes).astype(np.float32)


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
    needed = _least_frames(m2c.shape[1], c.whiten_order if whiten else 0, c.lags)
    if n_frames < needed:
        raise TooFewFrames(
            f"{n_frames} frames cannot constrain {m2c.shape[1]} modes; ask for at least {needed} frames, "
            "or for fewer modes (basis.n_modes)"
        )
    to_modes = np.linalg.pinv(m2c)
    session = _Session(
        bench, c.whiten_order if whiten else 0, c.lags, m2c.shape[1], grid, min(SETUP_FRAMES, n_frames),
        correlations, kind_of(bench).long_look,
    )  # fmt: skip
    session.kept = [] if record else None
    shortened, partial = 0, False
    report = Reporter("DO-CRIME", n_frames)
    try:
        bench.dm.flatten()
        prepare_sensor(bench)
        try:
            for done in range(n_frames):
                frame = next_frame(bench)
                wanted = m2c @ (amplitude * bench.rng.uniform(-1.0, 1.0, m2c.shape[1]))
                allowed = reachable(bench.dm, wanted)
                shortened += not np.array_equal(wanted, allowed)
                # What was really sent, not what was asked for: a shortened poke is still a known poke.
                session.take(frame, to_modes @ bench.dm.send(allowed).sent)
                if report.due():
                    yield report(done + 1, shortened=float(shortened))
        except Aborted:
            partial = True
    finally:
        bench.dm.flatten()
    session.ready()
    if session.estimator is None or session.grid is None or session.motion is None:
        raise Aborted("aborted before the first frames")
    try:
        solution = session.estimator.solve()
    except TooFewFrames:
        if partial:
            raise Aborted(f"aborted after {session.taken} frames, too few for a matrix") from None
        raise
    response = solution.response
    matrix = measured_matrix(
        bench, session.grid, m2c, solution.matrix, solution.sigma,
        "docrime-whitened" if whiten else "docrime",
        frames=solution.frames, lost_frames=solution.lost_frames, poke=float(poke),
        shortened=shortened, delay_frames=response.delay, whitening_order=solution.whitener.size - 1,
    )  # fmt: skip
    notes = []
    if float(np.median(matrix.snr())) < 1:
        notes.append("the median mode has a signal-to-noise ratio below 1; use more frames or larger pokes")
    seconds = (solution.frames + solution.lost_frames) / bench.wfs.settings.frame_rate_hz
    if session.mean_frame is not None and seconds < _REFERENCE_S:
        notes.append(session.grid.short_look.format(seconds=seconds))
    result = CalibrationResult(
        matrix,
        session.finished_grid(),
        solution.frames,
        solution.lost_frames,
        seconds,
        response,
        partial=partial,
        mean_frame=session.mean_frame,
        notes=tuple(notes),
    )
    return DocrimeRun(result, solution, session.record())


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


def _least_frames(n_modes: int, order: int, lags: int) -> int:
    """Fewest frames worth starting with: twice the unknowns per slope."""
    return 2 * (n_modes + order + lags)
