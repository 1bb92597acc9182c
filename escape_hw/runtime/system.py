"""An open system, as scripts and notebooks use it."""

from __future__ import annotations

import os
from collections.abc import Sequence
from typing import TYPE_CHECKING

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import SensorGeometry, SlopeFunction
from escape_hw.config.load import load_system
from escape_hw.runtime.loop_bench import LoopBench

if TYPE_CHECKING:
    from escape_hw.calibration.checkpoint import Checkpoint
    from escape_hw.calibration.sensor_setup import SensorSetup
    from escape_hw.calibration.stopping import Target


class System(LoopBench):
    """A bench with everything that can be done on it.

    While it is open, linear algebra runs on one thread: the products of a loop are small.

    The methods that take a while run a procedure to its end; ``progress=True`` shows a bar with the
    time left on standard error. Ctrl-C stops any of them: the mirror is flattened and
    :class:`~escape_hw.errors.Aborted` carries what was measured so far as ``partial``.
    """

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
        from escape_hw.calibration.sensor_setup import find_sensor

        return self.run(find_sensor(self, frames=frames), progress=progress)

    def slopes_of(self, grid: SensorGeometry) -> SlopeFunction:
        """A function that takes ``frame.data`` and returns slopes ``(n_slopes,)``.

        Parameters
        ----------
        grid
            From :meth:`find_sensor` or a calibration.
        """
        from escape_hw.calibration.sensor_setup import extractor

        return extractor(self, grid)

    def calibrate(
        self,
        method: str = "escape",
        *,
        frames: int | None = None,
        poke: float | None = None,
        grid: SensorGeometry | None = None,
        whiten: bool = True,
        estimator: str | None = None,
        closing: CalibrationResult | None = None,
        until: Target | None = None,
        keep: Checkpoint | None = None,
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
            An earlier calibration: its matrix closes the loop, and the pokes stand beside the integrator.
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
        from escape_hw.runtime.procedures import calibrate_by

        procedure = calibrate_by(
            self, method, frames=frames, poke=poke, grid=grid, whiten=whiten, estimator=estimator,
            closing=closing, until=until, keep=keep,
        )  # fmt: skip
        return self.run(procedure, progress=progress)

    def find_registration(self, matrix: InteractionMatrix, grid: SensorGeometry) -> RegistrationEstimate:
        """Where the mirror sits on the sensor, from a measured matrix (SPRINT); nothing moves.

        ``calibrate("escape")`` does this as well, and its error bars are the better ones: it still
        knows how the turbulence moves slopes together, which a matrix tells only roughly.

        Parameters
        ----------
        matrix
            A measured matrix, by push-pull or DO-CRIME.
        grid
            The grid it was measured on.

        Raises
        ------
        CalibrationError
            The matrix holds no signal.
        IncompatibleProduct
            Matrix and model have different actuators or sub-apertures.
        """
        from escape_hw.calibration.sprint import sprint
        from escape_hw.calibration.sprint_settings import as_configured

        settings = self.config.calibration
        modes = min(settings.sprint_modes, matrix.n_modes)
        return sprint(
            matrix,
            self.model(grid),
            modes=modes,
            **as_configured(settings),
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
