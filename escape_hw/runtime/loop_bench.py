"""What is done on a bench in closed loop: close it, tune it, scale, compare and track matrices."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.results import LoopResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.api.tracking import TrackResult
from escape_hw.runtime.calibrated import Calibrated, calibration_of, matrix_and_grid
from escape_hw.runtime.running_bench import RunningBench

if TYPE_CHECKING:
    from escape_hw.calibration.gain_bootstrap import GainsRun
    from escape_hw.runtime.sweep.result import SweepResult


class LoopBench(RunningBench):
    """A bench with everything that closes its loop."""

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
        from escape_hw.runtime.procedures import model_psf

        return self.run(model_psf(self, frames=frames), progress=progress)

    def close_loop(
        self,
        matrix: InteractionMatrix | Calibrated,
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
        from escape_hw.calibration.closed_loop import closed_loop

        matrix, grid = matrix_and_grid(matrix, grid)
        procedure = closed_loop(
            self, matrix, grid,
            gain=gain, leak=leak, dropped_modes=dropped_modes, frames=frames, model_psf=model_psf,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    def find_best_gain(
        self,
        matrix: InteractionMatrix | Calibrated,
        grid: SensorGeometry | None = None,
        *,
        gains: tuple[float, ...] | None = None,
        frames: int = 1500,
        model_psf: NDArray[np.float32] | None = None,
        progress: bool = False,
    ) -> tuple[float, list[LoopResult]]:
        """The gain with the least residual or, given a model PSF, the highest Strehl ratio.

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
        gain : float
        runs : list of LoopResult
            One run per gain that was tried.

        Raises
        ------
        CalibrationError
            No gain gives a stable loop.
        Aborted
            Stopped by Ctrl-C.
        """
        from escape_hw.calibration.gain_search import best_gain

        matrix, grid = matrix_and_grid(matrix, grid)
        procedure = best_gain(self, matrix, grid, gains=gains, frames=frames, model_psf=model_psf)
        return self.run(procedure, progress=progress)

    def find_optical_gains(
        self,
        calibration: Calibrated,
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
            ``result`` holds the gains, ``rescaled`` the matrix to close the loop with.

        Raises
        ------
        CalibrationError
            The loop does not close, or does not stay closed; says why.
        Aborted
            Stopped by Ctrl-C.
        """
        from escape_hw.calibration.gain_bootstrap import bootstrap_gains
        from escape_hw.calibration.pseudo_synthetic import at_rest

        calibration = calibration_of(calibration)
        procedure = bootstrap_gains(
            self, calibration, poke=poke, accuracy=accuracy, frames=frames,
            shape=at_rest(self, calibration), model_psf=model_psf,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    def sweep(
        self,
        matrices: Mapping[str, Calibrated],
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
        from escape_hw.runtime.sweep.ask import sweep_of

        asked = {"trials": trials, "frames": frames, "sampler": sampler, "margin": margin, "storage": storage}
        return sweep_of(
            self, matrices, Path(folder), vary, asked, workers=workers, scheduler=scheduler, progress=progress
        )

    def track(
        self,
        calibration: Calibrated,
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
            From :meth:`calibrate` or ``escape_hw.load_matrix``, or the ``rescaled`` one of
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
        from escape_hw.calibration.track import track

        calibration = calibration_of(calibration)
        procedure = track(
            self, calibration.matrix, calibration.grid, seconds=seconds,
            registration=calibration.registration, response=calibration.response, poke=poke,
            memory_s=memory_s, exchange=exchange, gain=gain, model_psf=model_psf,
        )  # fmt: skip
        return self.run(procedure, progress=progress)
