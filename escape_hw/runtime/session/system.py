"""An open system for scripts and notebooks: devices, calibration, closed loop, tracking, sweep."""

from __future__ import annotations

import logging
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import Observer, Procedure, StopSignal
from escape_hw.api.procedure import run as run_procedure
from escape_hw.api.results import CalibrationResult, LoopResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.api.tracking import TrackResult
from escape_hw.bench import Bench
from escape_hw.config import layouts
from escape_hw.config.loader import load_system
from escape_hw.errors import DeviceError
from escape_hw.runtime.procedures.calibration import DocrimeProcedure, EscapeProcedure
from escape_hw.runtime.procedures.declaration import ProcedureSpec
from escape_hw.runtime.procedures.gains import GainsProcedure
from escape_hw.runtime.procedures.loop import LoopProcedure
from escape_hw.runtime.procedures.model_psf import ModelPsfProcedure
from escape_hw.runtime.procedures.python_method import procedure_method
from escape_hw.runtime.procedures.sensor import SensorProcedure
from escape_hw.runtime.procedures.track import TrackProcedure
from escape_hw.runtime.session.calibration_input import CalibrationLike, as_calibration, as_matrix_and_grid

if TYPE_CHECKING:
    from escape_hw.calibration.acquisition.checkpoint import Checkpoint
    from escape_hw.calibration.acquisition.sensor_setup import SensorSetup
    from escape_hw.calibration.acquisition.stopping import Target
    from escape_hw.calibration.loop.gain_search import GainSearch
    from escape_hw.calibration.optical_gain.bootstrap import GainsRun
    from escape_hw.runtime.sweep.result import SweepResult


ResultT = TypeVar("ResultT")
log = logging.getLogger(__name__)


class System(Bench):
    """An open bench with methods for calibration, closed loop and tracking.

    While it is open, linear algebra runs on one thread, because the matrix products of a loop are small.

    The measuring methods run a procedure to its end; ``progress=True`` shows a bar with the time left on
    standard error. Ctrl-C stops a procedure: the mirror is flattened, and
    :class:`~escape_hw.errors.Aborted` is raised with the partial result as ``partial``.
    """

    def run(
        self,
        procedure: Procedure[ResultT] | ProcedureSpec[ResultT],
        *,
        observers: tuple[Observer, ...] = (),
        abort: StopSignal | None = None,
        progress: bool = False,
    ) -> ResultT:
        """Run a procedure to its end and return its result; nothing is saved.

        Parameters
        ----------
        procedure
            A generator that uses this bench, or a declared procedure such as
            :class:`~escape_hw.runtime.procedures.loop.LoopProcedure` with its parameters.
        observers
            Called with every progress report.
        abort
            Stops the procedure when it is set, from any thread.
        progress
            Show a bar with the time left on standard error.

        Raises
        ------
        Aborted
            Stopped by ``abort`` or Ctrl-C.
        """
        if isinstance(procedure, ProcedureSpec):
            procedure = procedure.on_bench(self)
        try:
            result = self._run(procedure, observers, abort, progress)
        except BaseException:
            try:
                self._leave_flat()
            except DeviceError as second:
                log.error("the mirror could NOT be made flat: %s", second)
            raise
        self._leave_flat()
        return result

    def _run(
        self,
        procedure: Procedure[ResultT],
        observers: tuple[Observer, ...],
        abort: StopSignal | None,
        progress: bool,
    ) -> ResultT:
        if not progress:
            return run_procedure(procedure, observers=observers, abort=abort)

        from escape_hw.runtime.display.console import DisplayConsole
        from escape_hw.runtime.display.progress import ProgressView

        with ProgressView(DisplayConsole()) as view:
            return run_procedure(procedure, observers=(*observers, view), abort=abort)

    def _leave_flat(self) -> None:
        """Flatten the mirror after a procedure that did not."""
        if self.dm.is_open and not np.array_equal(self.dm.shape, self.dm.flat):
            self.dm.flatten()

    @procedure_method(ModelPsfProcedure)
    def take_model_psf(self, *, frames: int = 20, progress: bool = False) -> NDArray[np.float32]:
        """Measure the PSF of the flat mirror without turbulence, the reference of Strehl ratios.

        Returns
        -------
        ndarray of float32, ``(rows, columns)``
            In counts.

        Raises
        ------
        CalibrationError
            The system has no science camera.
        """
        from escape_hw.runtime.procedures.model_psf import model_psf

        return self.run(model_psf(self, frames=frames), progress=progress)

    @procedure_method(LoopProcedure)
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
        """Close the loop for a number of frames, then open it and flatten the mirror.

        Parameters
        ----------
        matrix, grid
            A calibration from :meth:`calibrate` or ``escape_hw.load_matrix``; or a matrix and its grid.
        model_psf
            From :meth:`take_model_psf`; needed for the Strehl ratios.

        Returns
        -------
        LoopResult
            ``stable`` is false if the loop was opened because it diverged.

        Raises
        ------
        IncompatibleProduct
            The matrix belongs to another mirror or grid.
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
            A calibration from :meth:`calibrate` or ``escape_hw.load_matrix``; or a matrix and its grid.
        gains
            Gains to try; fractions of the largest stable gain by default.
        frames
            Frames per gain.
        model_psf
            From :meth:`take_model_psf`; gains are then compared by the Strehl ratio.
        progress
            Show a bar with the time left.

        Returns
        -------
        GainSearch
            ``gain``, its standard error ``sigma``, and ``runs``, one per gain; unpacks as ``gain, runs``.

        Raises
        ------
        CalibrationError
            The loop is not stable with any of the gains.
        """
        from escape_hw.calibration.loop.gain_search import find_best_gain

        matrix, grid = as_matrix_and_grid(matrix, grid)
        procedure = find_best_gain(self, matrix, grid, gains=gains, frames=frames, model_psf=model_psf)
        return self.run(procedure, progress=progress)

    @procedure_method(GainsProcedure)
    def find_optical_gains(
        self,
        calibration: CalibrationLike,
        *,
        poke: float = 0.002,
        accuracy: float = 0.01,
        allowed_strehl_loss: float = 0.01,
        frames: int = 20000,
        gain: float | None = None,
        model_psf: NDArray[np.float32] | None = None,
        progress: bool = False,
    ) -> GainsRun:
        """Close the loop on a matrix of unknown scale and scale it to the turbulence, mode by mode.

        Parameters
        ----------
        calibration
            From :meth:`calibrate`, preferably with ``"escape"``, or ``escape_hw.load_matrix``.
        model_psf
            From :meth:`take_model_psf`; every round then measures the Strehl ratio.

        Returns
        -------
        GainsRun
            ``result`` holds the gains, ``rescaled_calibration`` the matrix to close the loop with.

        Raises
        ------
        CalibrationError
            The loop cannot be closed, or diverges; the message gives the reason.
        """
        from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
        from escape_hw.calibration.sprint.synthetic_matrix import static_light_matrix

        calibration = as_calibration(calibration)
        procedure = bootstrap_gains(
            self, calibration, poke=poke, accuracy=accuracy, allowed_strehl_loss=allowed_strehl_loss,
            frames=frames, gain=gain, closed_loop_matrix=static_light_matrix(self, calibration),
            model_psf=model_psf,
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
        """Compare matrices, each at its best loop parameters, in the same turbulence.

        With twins the loops run in parallel processes, each on its own twin; on hardware they run one after
        the other on this bench. A second call with the same folder continues the sweep.

        Parameters
        ----------
        matrices
            Calibrations or loaded matrices by name; the others are compared with the first.
        folder
            Folder for the matrices and, by default, the trials.
        vary
            ``"gain=0.1:1"``, ``"leak=1e-3:0.1:log"``, ``"twin.latency_s=0:2e-3"`` ...; gain, leak and dropped
            modes have default ranges on twins and none on hardware.
        trials
            Loops with drawn parameters, over all matrices.
        frames
            Frames of each loop.
        sampler
            ``"random"``, the same draws for every matrix, or ``"tpe"``.
        margin
            Largest difference of Strehl ratios that counts as equivalent.
        workers, scheduler
            Processes, or the address of a Dask scheduler.
        storage
            SQLAlchemy URL of the study; SQLite in the folder by default.
        progress
            Show a bar with the time left.

        Raises
        ------
        ConfigError
            Optuna is not installed, a range is invalid, or a range is missing on hardware.
        CalibrationError
            The loop with one of the matrices is never stable.
        """
        from escape_hw.runtime.sweep.request import run_matrix_sweep

        asked = {"trials": trials, "frames": frames, "sampler": sampler, "margin": margin, "storage": storage}
        return run_matrix_sweep(
            self,
            self.run,
            matrices,
            Path(folder),
            vary,
            asked,
            workers=workers,
            scheduler=scheduler,
            progress=progress,
        )

    @procedure_method(TrackProcedure)
    def track(
        self,
        calibration: CalibrationLike,
        *,
        seconds: float = 60.0,
        poke: float | None = None,
        forgetting_time_s: float | None = None,
        exchange: bool = True,
        gain: float | None = None,
        model_psf: NDArray[np.float32] | None = None,
        progress: bool = False,
    ) -> TrackResult:
        """Close the loop and follow drifts of registration, optical gains and matrix; the mirror ends flat.

        Parameters
        ----------
        calibration
            From :meth:`calibrate`, ``escape_hw.load_matrix``, or ``rescaled_calibration`` of
            :meth:`find_optical_gains`; a missing registration is estimated from the matrix.
        model_psf
            From :meth:`take_model_psf`; the Strehl ratio is then followed too.

        Returns
        -------
        TrackResult
            ``rows`` holds a row per second, ``latest`` the last matrix, ``alarms`` changes that a new
            registration does not explain. ``stable`` is false if the loop was opened because it diverged.

        Raises
        ------
        ConfigError
            The duration, poke or forgetting time is out of range; nothing has moved.
        IncompatibleProduct, CalibrationError
            The matrix belongs to another system, cannot be inverted, or holds no registration; nothing has
            moved.
        """
        from escape_hw.calibration.tracking.tracker import track

        calibration = as_calibration(calibration)
        procedure = track(
            self, calibration.matrix, calibration.grid, seconds=seconds,
            registration=calibration.registration, response=calibration.response, poke=poke,
            forgetting_time_s=forgetting_time_s, exchange=exchange, gain=gain, model_psf=model_psf,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    @procedure_method(SensorProcedure)
    def find_sensor(self, *, frames: int = 200, progress: bool = False) -> SensorSetup:
        """Find the geometry of the sensor on averaged frames; the mirror is not moved.

        Returns
        -------
        SensorSetup
            ``grid`` is the geometry.

        Raises
        ------
        CalibrationError
            There are no spots or pupil images where the configuration expects them.
        """
        from escape_hw.calibration.acquisition.sensor_setup import find_sensor

        return self.run(find_sensor(self, frames=frames), progress=progress)

    def slopes_of(self, grid: SensorGeometry) -> SlopeFunction:
        """A function that computes slopes ``(n_slopes,)`` from ``frame.data``.

        Parameters
        ----------
        grid
            From :meth:`find_sensor` or a calibration.
        """
        from escape_hw.calibration.acquisition.sensor_setup import build_slope_function

        return build_slope_function(self, grid)

    @procedure_method(EscapeProcedure, DocrimeProcedure, renamed={"keep": "checkpoint"})
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
            ``"push-pull"`` (needs a source; a movable phase screen is taken out of the beam),
            ``"modulated"`` (with or without a source), ``"push-pull-fast"``, ``"docrime"`` or ``"escape"``
            (these three under turbulence, in open or closed loop).
        grid
            Geometry of the sensor, if it is known already; found on the frames by default. ``closed_loop`` is
            a calibration here, whose matrix closes the loop.
        until
            Stop at this signal-to-noise ratio or accuracy.
        checkpoint
            File for the state of the run, and the state to resume from.

        Returns
        -------
        CalibrationResult
            The argument of :meth:`close_loop`.

        Raises
        ------
        ConfigError
            The method is unknown, or arguments exclude each other.
        TooFewFrames, CalibrationError
            The frames cannot constrain the matrix, or the sensor gets no light.
        """
        from escape_hw.runtime.procedures.calibration import calibrate_with_method

        procedure = calibrate_with_method(
            self, method, frames=frames, poke=poke, grid=grid, whiten=whiten, estimator=estimator,
            closed_loop=None if closed_loop is None else as_calibration(closed_loop), until=until,
            checkpoint=checkpoint,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    def find_registration(
        self, matrix: InteractionMatrix | CalibrationLike, grid: SensorGeometry | None = None
    ) -> RegistrationEstimate:
        """Estimate the registration from a measured matrix with SPRINT; nothing moves.

        ``calibrate("escape")`` includes this step and has the more accurate standard errors, because it uses
        the covariance of the slopes under turbulence, of which a matrix keeps an approximation only.

        Parameters
        ----------
        matrix
            A measured matrix, or a calibration from :meth:`calibrate` or ``escape_hw.load_matrix``; for a
            pseudo-synthetic one, the measured matrix behind it is used.
        grid
            The grid of the matrix; a calibration has its own.

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
        layouts.require_same_positions(matrix.layout, self.config.devices.dm.layout, "the matrix")
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

    Use the system in a ``with`` statement, or call ``close()``, which flattens the mirror.

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
