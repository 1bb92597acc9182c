"""An open system for scripts and notebooks: devices, calibration, closed loop, tracking, sweep."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeAlias, TypeVar, Union

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Observer, Procedure, StopSignal
from escape_hw.api.procedure import run as run_procedure
from escape_hw.api.results import CalibrationResult, LoopResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.api.tracking import TrackResult
from escape_hw.bench import Bench
from escape_hw.config.loader import load_system

if TYPE_CHECKING:
    from escape_hw.calibration.acquisition.checkpoint import Checkpoint
    from escape_hw.calibration.acquisition.sensor_setup import SensorSetup
    from escape_hw.calibration.acquisition.stopping import Target
    from escape_hw.calibration.loop.gain_search import GainSearch
    from escape_hw.calibration.optical_gain.bootstrap import GainsRun
    from escape_hw.io.fits.matrix import MatrixProduct
    from escape_hw.runtime.sweep.result import SweepResult


#: What ``calibrate`` or ``load_matrix`` returns.
CalibrationLike: TypeAlias = Union[CalibrationResult, "MatrixProduct"]

_EXPECTED = "what calibrate() or escape_hw.load_matrix() returns is needed"
#: Results with a calibration in them, which their reader has to choose.
_CONTAINERS = ("rescaled", "latest")


def as_calibration(value: object) -> CalibrationResult:
    """A calibration, be it one or a product that holds one.

    Raises
    ------
    TypeError
        It is something else; says which, and the way out.
    """
    if isinstance(value, CalibrationResult):
        return value
    result = getattr(value, "result", None)
    if isinstance(result, CalibrationResult):
        return result
    raise TypeError(f"{_EXPECTED}, not a {type(value).__name__}{_suggestion(value)}")


def as_matrix_and_grid(
    value: InteractionMatrix | CalibrationLike, grid: SensorGeometry | None
) -> tuple[InteractionMatrix, SensorGeometry]:
    """A matrix and the geometry that it belongs to; a grid that is given goes before a calibration's own.

    Raises
    ------
    TypeError
        A matrix without its geometry, or neither a matrix nor a calibration; says the way out.
    """
    if not isinstance(value, InteractionMatrix):
        found = as_calibration(value)
        return found.matrix, found.grid if grid is None else grid
    if grid is None:
        raise TypeError(f"a matrix alone does not tell its geometry: give the grid as well, or {_EXPECTED}")
    return value, grid


def _suggestion(value: object) -> str:
    if isinstance(value, str | os.PathLike):
        return f"; read it: escape_hw.load_matrix({os.fspath(value)!r})"
    if isinstance(value, InteractionMatrix):
        return "; a matrix alone does not tell its geometry"
    for name in _CONTAINERS:
        if hasattr(value, name):
            return f"; take its .{name}"
    return ""


ResultT = TypeVar("ResultT")


class System(Bench):
    """A bench with everything that can be done on it.

    While it is open, linear algebra runs on one thread: the products of a loop are small.

    The methods that take a while run a procedure to its end; ``progress=True`` shows a bar with the
    time left on standard error. Ctrl-C stops any of them: the mirror is flattened and
    :class:`~escape_hw.errors.Aborted` carries what was measured so far as ``partial``.
    """

    def run(
        self,
        procedure: Procedure[ResultT],
        *,
        observers: tuple[Observer, ...] = (),
        abort: StopSignal | None = None,
        progress: bool = False,
    ) -> ResultT:
        """Drive a procedure to its end and return its result.

        Parameters
        ----------
        procedure
            A generator made from this bench, such as one's own.
        observers
            Called with every progress report.
        abort
            Set it from any thread to stop the procedure.
        progress
            Show a bar with the time left on standard error.

        Raises
        ------
        Aborted
            Stopped by ``abort`` or Ctrl-C.
        """
        if not progress:
            return run_procedure(procedure, observers=observers, abort=abort)
        from rich.console import Console

        from escape_hw.runtime.display.progress import ProgressView

        with ProgressView(Console(stderr=True)) as view:
            return run_procedure(procedure, observers=(*observers, view), abort=abort)

    def take_model_psf(self, *, frames: int = 20, progress: bool = False) -> NDArray[np.float32]:
        """The PSF of the flat mirror without turbulence, which Strehl ratios are measured against.

        Parameters
        ----------
        frames
            Science frames to average.
        progress
            Show a bar with the time left.

        Returns
        -------
        ndarray of float32, ``(rows, columns)``
            In counts.

        Raises
        ------
        CalibrationError
            The system has no science camera.
        """
        from escape_hw.runtime.procedures.calibration import model_psf

        return self.run(model_psf(self, frames=frames), progress=progress)

    def close_loop(
        self,
        matrix: InteractionMatrix | CalibrationLike,
        grid: SensorGeometry | None = None,
        *,
        gain: float | None = None,
        leak: float | None = None,
        dropped_modes: int | None = None,
        frames: int = 5000,
        model_psf: NDArray[np.float32] | None = None,
        progress: bool = False,
    ) -> LoopResult:
        """Close the loop for a number of frames and open it again; the mirror ends flat.

        Parameters
        ----------
        matrix, grid
            A calibration, as :meth:`calibrate` or ``escape_hw.load_matrix`` returns it; or its matrix and its
            grid.
        gain, leak, dropped_modes
            Loop parameters; as configured by default.
        frames
            How long.
        model_psf
            From :meth:`take_model_psf`; with it the Strehl ratios are measured.
        progress
            Show a bar with the time left.

        Returns
        -------
        LoopResult
            ``stable`` is false when the loop was opened because it diverged.

        Raises
        ------
        IncompatibleProduct
            The matrix belongs to another mirror or grid.
        Aborted
            Stopped by Ctrl-C.
        """
        from escape_hw.calibration.loop.performance import close_loop

        matrix, grid = as_matrix_and_grid(matrix, grid)
        procedure = close_loop(
            self, matrix, grid,
            gain=gain, leak=leak, dropped_modes=dropped_modes, frames=frames, model_psf=model_psf,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    def find_best_gain(
        self,
        matrix: InteractionMatrix | CalibrationLike,
        grid: SensorGeometry | None = None,
        *,
        gains: tuple[float, ...] | None = None,
        frames: int = 1500,
        model_psf: NDArray[np.float32] | None = None,
        progress: bool = False,
    ) -> GainSearch:
        """Close the loop at several gains and find the one with the highest Strehl ratio or lowest residual.

        Parameters
        ----------
        matrix, grid
            A calibration, as :meth:`calibrate` or ``escape_hw.load_matrix`` returns it; or its matrix and its
            grid.
        gains
            Gains to try; by default shares of the largest stable one.
        frames
            Frames per gain.
        model_psf
            From :meth:`take_model_psf`; with it gains are judged by the Strehl ratio.
        progress
            Show a bar with the time left.

        Returns
        -------
        GainSearch
            ``gain``, its standard error ``sigma``, and ``runs``, one per gain; unpacks as ``gain, runs``.

        Raises
        ------
        CalibrationError
            No gain gives a stable loop.
        Aborted
            Stopped by Ctrl-C.
        """
        from escape_hw.calibration.loop.gain_search import find_best_gain

        matrix, grid = as_matrix_and_grid(matrix, grid)
        procedure = find_best_gain(self, matrix, grid, gains=gains, frames=frames, model_psf=model_psf)
        return self.run(procedure, progress=progress)

    def find_optical_gains(
        self,
        calibration: CalibrationLike,
        *,
        poke: float = 0.002,
        accuracy: float = 0.01,
        frames: int = 20000,
        model_psf: NDArray[np.float32] | None = None,
        progress: bool = False,
    ) -> GainsRun:
        """Close the loop on a matrix of unknown scale and scale it, mode by mode, to the turbulence there.

        Parameters
        ----------
        calibration
            From :meth:`calibrate`, best with ``"escape"``, or ``escape_hw.load_matrix``.
        poke
            Last poke of each mode, rms surface as fraction of full stroke; lowered to a cost of 1 % of the
            Strehl ratio.
        accuracy
            Relative standard error of the gains to go on for.
        frames
            Frames per round at most.
        model_psf
            From :meth:`take_model_psf`; with it every round tells its Strehl ratio.
        progress
            Show a bar with the time left.

        Returns
        -------
        GainsRun
            ``result`` holds the gains, ``rescaled_calibration`` the matrix to close the loop with.

        Raises
        ------
        CalibrationError
            The loop does not close, or does not stay closed; says why.
        Aborted
            Stopped by Ctrl-C.
        """
        from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
        from escape_hw.calibration.sprint.synthetic_matrix import static_light_matrix

        calibration = as_calibration(calibration)
        procedure = bootstrap_gains(
            self, calibration, poke=poke, accuracy=accuracy, frames=frames,
            closed_loop_matrix=static_light_matrix(self, calibration), model_psf=model_psf,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    def sweep(
        self,
        matrices: Mapping[str, CalibrationLike],
        folder: str | os.PathLike[str],
        *,
        vary: Sequence[str] = (),
        trials: int = 200,
        frames: int = 400,
        sampler: str = "random",
        margin: float = 0.01,
        workers: int = 2,
        scheduler: str | None = None,
        storage: str | None = None,
        progress: bool = False,
    ) -> SweepResult:
        """Compare matrices, each at its own best parameters, on the same air.

        On twins every loop has a twin of its own, in parallel processes; on hardware the loops run on this
        bench one after the other. Called again with the same folder it goes on where it was.

        Parameters
        ----------
        matrices
            Calibrations or loaded matrices by name; the first is the one that the others are compared with.
        folder
            Where the matrices and, by default, the trials are kept.
        vary
            ``"gain=0.1:1"``, ``"leak=1e-3:0.1:log"``, ``"twin.latency_s=0:2e-3"`` ...; gain, leak and dropped
            modes have usual ranges on twins and none on hardware.
        trials
            Loops with drawn parameters, over all matrices.
        frames
            Frames of each loop.
        sampler
            ``"random"``, the same draws for every matrix, or ``"tpe"``.
        margin
            Difference in the Strehl ratio that does not matter.
        workers, scheduler
            Processes, or the address of a Dask scheduler.
        storage
            SQLAlchemy's URL of the study; SQLite in the folder by default.
        progress
            Show a bar with the time left.

        Raises
        ------
        ConfigError
            Optuna is not installed, a range means nothing, or hardware without limits.
        CalibrationError
            No loop with one of the matrices stays closed.
        """
        from escape_hw.runtime.sweep.request import run_matrix_sweep

        asked = {"trials": trials, "frames": frames, "sampler": sampler, "margin": margin, "storage": storage}
        return run_matrix_sweep(
            self, matrices, Path(folder), vary, asked, workers=workers, scheduler=scheduler, progress=progress
        )

    def track(
        self,
        calibration: CalibrationLike,
        *,
        seconds: float = 60.0,
        poke: float | None = None,
        memory_s: float | None = None,
        exchange: bool = True,
        gain: float | None = None,
        model_psf: NDArray[np.float32] | None = None,
        progress: bool = False,
    ) -> TrackResult:
        """Close the loop and follow what drifts: registration, optical gains, matrix; the mirror ends flat.

        Parameters
        ----------
        calibration
            From :meth:`calibrate` or ``escape_hw.load_matrix``, or the ``rescaled_calibration`` one of
            :meth:`find_optical_gains`; a registration that is not in it is found from its matrix.
        seconds
            How long, at least one.
        poke
            Pokes of each mode, rms surface as fraction of full stroke; as configured by default.
        memory_s
            Time in which old frames fade; as configured by default.
        exchange
            False: new matrices are only proposed.
        gain
            Gain of the integrator; as configured by default.
        model_psf
            From :meth:`take_model_psf`; with it the Strehl ratio is followed, too.
        progress
            Show a bar with the time left.

        Returns
        -------
        TrackResult
            ``rows`` holds a line per second, ``latest`` the matrix to go on with, ``alarms`` what a new
            registration does not explain. ``stable`` is false when the loop was lost.

        Raises
        ------
        ConfigError
            A time, poke or memory that means nothing; nothing moved.
        IncompatibleProduct, CalibrationError
            The matrix does not fit, cannot be inverted, or shows no registration; nothing moved.
        Aborted
            Stopped by Ctrl-C.
        """
        from escape_hw.calibration.tracking.tracker import track

        calibration = as_calibration(calibration)
        procedure = track(
            self, calibration.matrix, calibration.grid, seconds=seconds,
            registration=calibration.registration, response=calibration.response, poke=poke,
            memory_s=memory_s, exchange=exchange, gain=gain, model_psf=model_psf,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    def find_sensor(self, *, frames: int = 200, progress: bool = False) -> SensorSetup:
        """Watch the sensor and find its geometry; the mirror stays as it is.

        Parameters
        ----------
        frames
            Frames to average; under turbulence, the more the better.
        progress
            Show a bar with the time left.

        Raises
        ------
        CalibrationError
            No spots or pupil images where the design says there should be.
        """
        from escape_hw.calibration.acquisition.sensor_setup import find_sensor

        return self.run(find_sensor(self, frames=frames), progress=progress)

    def slopes_of(self, grid: SensorGeometry) -> SlopeFunction:
        """A function that takes ``frame.data`` and returns slopes ``(n_slopes,)``.

        Parameters
        ----------
        grid
            From :meth:`find_sensor` or a calibration.
        """
        from escape_hw.calibration.acquisition.sensor_setup import build_slope_function

        return build_slope_function(self, grid)

    def calibrate(
        self,
        method: str = "escape",
        *,
        frames: int | None = None,
        poke: float | None = None,
        grid: SensorGeometry | None = None,
        whiten: bool = True,
        estimator: str | None = None,
        closed_loop: CalibrationLike | None = None,
        until: Target | None = None,
        checkpoint: Checkpoint | None = None,
        progress: bool = False,
    ) -> CalibrationResult:
        """Measure an interaction matrix and, with ``"escape"``, the registration behind it.

        Parameters
        ----------
        method
            ``"push-pull"`` (needs a source: the phase screen, where the bench moves one, is out of
            the beam meanwhile), ``"modulated"`` (with or without one), ``"push-pull-fast"``,
            ``"docrime"`` or ``"escape"`` (all three under turbulence, in open or closed loop).
        frames
            Frames to measure with (push-pull: per push and per pull; modulated: per batch of modes);
            as configured by default.
        poke
            Rms surface as fraction of full stroke; as configured by default.
        grid
            The sensor's grid, when it is known already; found on the frames by default.
        whiten
            False: the paper's plain estimator of ``"docrime"`` and ``"escape"``.
        estimator
            What ``"escape"`` fits: ``"matrix"``, ``"telemetry"`` (fewer frames than modes are enough)
            or ``"auto"``; as configured by default.
        closing
            An earlier calibration, or a loaded one: its matrix closes the loop, and the pokes stand beside
            the integrator.
        until
            Stop when this signal-to-noise ratio or accuracy is reached.
        keep
            Where the state is kept meanwhile, and what to go on with.
        progress
            Show a bar with the time left.

        Returns
        -------
        CalibrationResult
            ``matrix`` and ``grid`` are what :meth:`close_loop` needs.

        Raises
        ------
        ConfigError
            No such method.
        TooFewFrames, CalibrationError
            The data cannot constrain the matrix, or the sensor sees nothing.
        Aborted
            Stopped by Ctrl-C.
        """
        from escape_hw.runtime.procedures.calibration import calibrate_with_method

        procedure = calibrate_with_method(
            self, method, frames=frames, poke=poke, grid=grid, whiten=whiten, estimator=estimator,
            closed_loop=None if closed_loop is None else as_calibration(closed_loop), until=until, checkpoint=checkpoint,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    def find_registration(
        self, matrix: InteractionMatrix | CalibrationLike, grid: SensorGeometry | None = None
    ) -> RegistrationEstimate:
        """Where the mirror sits on the sensor, from a measured matrix (SPRINT); nothing moves.

        ``calibrate("escape")`` does this as well, and its error bars are the better ones: it still
        knows how the turbulence moves slopes together, which a matrix tells only roughly.

        Parameters
        ----------
        matrix
            A measured matrix, by push-pull or DO-CRIME, or a calibration, as :meth:`calibrate` or
            ``escape_hw.load_matrix`` returns it; of a pseudo-synthetic one, the measured matrix behind it.
        grid
            The grid it was measured on; a calibration tells its own.

        Raises
        ------
        CalibrationError
            The matrix holds no signal.
        IncompatibleProduct
            Matrix and model have different actuators or sub-apertures.
        """
        from escape_hw.calibration.sprint.fit import sprint, sprint_options_from_config

        if not isinstance(matrix, InteractionMatrix):
            found = as_calibration(matrix)
            matrix, grid = found.measured or found.matrix, found.grid if grid is None else grid
        matrix, grid = as_matrix_and_grid(matrix, grid)
        settings = self.config.calibration
        modes = min(settings.sprint_modes, matrix.n_modes)
        return sprint(
            matrix,
            self.model(grid),
            modes=modes,
            **sprint_options_from_config(settings),
        )


def open_system(
    system: str | os.PathLike[str],
    *,
    set: Sequence[str] = (),
    seed: int | None = None,
    mode: str | None = None,
) -> System:
    """Load a configuration, build its devices and open them.

    Use it in a ``with`` statement, or call ``close()``: that flattens the mirror.

    Parameters
    ----------
    system
        Name of a bundled system, or path of a TOML file.
    set
        Overrides, ``section.key=value`` each.
    seed
        Seed of every random stream; absent: as configured.
    mode
        ``'sim'`` or ``'hardware'``; absent: as configured.

    Raises
    ------
    ConfigError
        The configuration is wrong or a driver is not installed; nothing was opened.
    DeviceError
        A device cannot be reached; nothing is left open.
    """
    return System.from_config(load_system(system, overrides=set, seed=seed, mode=mode)).open()
