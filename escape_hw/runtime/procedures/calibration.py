"""Calibration by any method: choice of the procedure, request, resuming, saving."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.errors import ConfigError, ProductError
from escape_hw.runtime.procedures.task import (
    SavedRun,
    load_fitting_matrix,
    require_hardware_matrix,
    set_overrides,
)
from escape_hw.runtime.session.record import without_turbulence

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.calibration.acquisition.checkpoint import Checkpoint
    from escape_hw.calibration.acquisition.stopping import Target
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.fits.matrix import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord


#: The calibration methods, by the names that the command line knows as well.
METHODS = ("push-pull", "push-pull-fast", "modulated", "docrime", "escape")
#: Those that work in closed loop as well.
CLOSED_LOOP = ("push-pull-fast", "docrime", "escape")


def calibrate_with_method(
    bench: Bench,
    method: str = "escape",
    *,
    frames: int | None = None,
    poke: float | None = None,
    grid: SensorGeometry | None = None,
    whiten: bool = True,
    estimator: str | None = None,
    closed_loop: CalibrationResult | None = None,
    until: Target | None = None,
    checkpoint: Checkpoint | None = None,
) -> Procedure[CalibrationResult]:
    """A calibration by the name of its method.

    Slow push-pull needs a source: the phase screen, where the bench moves one, is out of the beam
    meanwhile. The others take the light as it is.

    Parameters
    ----------
    bench
        An open bench.
    method
        One of :data:`METHODS`.
    frames
        Frames to measure with (push-pull: per push and per pull); as configured by default.
    poke
        Rms surface as fraction of full stroke; as configured by default.
    grid
        The sensor's grid, when it is known already.
    whiten
        False: the paper's plain estimator of ``docrime`` and ``escape``.
    estimator
        What ``escape`` fits: ``"matrix"``, ``"telemetry"`` or ``"auto"``; as configured by default.
    closing
        Measure in closed loop, with this calibration's matrix; the methods of :data:`CLOSED_LOOP`.
    until
        Stop when this is reached.
    keep
        Where the state is kept meanwhile, and what to go on with.

    Raises
    ------
    ConfigError
        No such method, or options that do not go together; nothing moved.
    TooFewFrames, CalibrationError, Aborted
        See :func:`~escape_hw.calibration.push_pull.procedure.push_pull`,
        :func:`~escape_hw.calibration.docrime.open_loop.docrime`, :func:`~escape_hw.calibration.escape.method.escape`.
    """
    # Imported when used: these bring compilers along, and a bench opens without them.
    if method not in METHODS:
        raise ConfigError(f"calibration method '{method}' is unknown; it is one of {', '.join(METHODS)}")
    if closed_loop is not None and method not in CLOSED_LOOP:
        raise ConfigError(f"'{method}' is for open loop; in closed loop: {', '.join(CLOSED_LOOP)}")
    if closed_loop is not None and not whiten:
        raise ConfigError("the plain estimator is for open loop; in closed loop turbulence is whitened")
    common: dict[str, Any] = {"frames": frames, "poke": poke, "until": until, "checkpoint": checkpoint}
    if method == "push-pull":
        from escape_hw.calibration.push_pull.procedure import push_pull

        with without_turbulence(bench):
            return (yield from push_pull(bench, grid=grid, **common))
    if method == "modulated":
        from escape_hw.calibration.push_pull.modulation import modulation_demodulation

        return (yield from modulation_demodulation(bench, grid=grid, **common))
    if method == "escape":
        from escape_hw.calibration.escape.method import escape

        return (
            yield from escape(
                bench, grid=grid, whiten=whiten, estimator=estimator, closed_loop=closed_loop, **common
            )
        )
    if method == "push-pull-fast":
        from escape_hw.calibration.acquisition.pokes import PushPullPokes

        common["pattern"] = PushPullPokes
        common["poke"] = bench.config.calibration.push_pull_poke if poke is None else poke
    if closed_loop is not None:
        from escape_hw.calibration.docrime.closed_loop import docrime_closed_loop

        return (yield from docrime_closed_loop(bench, closed_loop, **common))
    from escape_hw.calibration.docrime.open_loop import docrime

    return (yield from docrime(bench, grid=grid, whiten=whiten, **common))


def model_psf(bench: Bench, *, frames: int = 20) -> Procedure[NDArray[np.float32]]:
    """The PSF to measure Strehl ratios against, with the turbulence out of the beam meanwhile.

    Parameters
    ----------
    bench
        An open bench with a science camera.
    frames
        Science frames to average.

    Raises
    ------
    CalibrationError
        The system has no science camera.
    """
    from escape_hw.calibration.acquisition.model_psf import measure_model_psf

    with without_turbulence(bench):
        return (yield from measure_model_psf(bench, frames=frames))


@dataclass(frozen=True, slots=True)
class CalibrationRequest:
    """How a calibration is asked for; kept with its state, so that it can be resumed without asking again."""

    method: str = "escape"
    frames: int | None = None
    poke: float | None = None
    accuracy: float | None = None
    snr: float | None = None
    plain: bool = False
    estimator: str | None = None
    closed_loop: str | None = None

    def validate(self) -> CalibrationRequest:
        """The request, if its parts go together.

        Raises
        ------
        ConfigError
            They do not; nothing was opened.
        """
        from escape_hw.config.system import ESTIMATORS

        if self.method not in METHODS:
            raise ConfigError(f"--method {self.method}: unknown; it is one of {', '.join(METHODS)}")
        if self.poke is not None and not 0 < self.poke <= 1:
            raise ConfigError(f"--poke {self.poke:g}: it must lie in (0, 1], a fraction of full stroke")
        if self.accuracy is not None and (self.method != "escape" or not self.accuracy > 0):
            raise ConfigError("--accuracy: it goes with --method escape and must be positive")
        if self.snr is not None and not self.snr > 0:
            raise ConfigError(f"--snr {self.snr:g}: it must be positive")
        if self.plain and (self.method != "docrime" or self.closed_loop is not None):
            raise ConfigError("--plain: it goes with --method docrime in open loop")
        if self.closed_loop is not None and self.method not in CLOSED_LOOP:
            raise ConfigError(f"--closed-loop: it goes with --method {', '.join(CLOSED_LOOP)}")
        if self.estimator is not None and (self.method != "escape" or self.estimator not in ESTIMATORS):
            raise ConfigError(
                f"--estimator {self.estimator}: it goes with --method escape and is one of "
                f"{', '.join(ESTIMATORS)}"
            )
        return self

    @classmethod
    def from_options(cls, asked: Mapping[str, Any], resume: Path | None = None) -> CalibrationRequest:
        """What is asked for, with what the run to resume was asked for where nothing (``None``) is said.

        Raises
        ------
        ConfigError
            Its parts do not go together.
        ProductError
            There is nothing to resume.
        """
        options = {key: value for key, value in asked.items() if value is not None}
        if resume is None:
            return cls(**options).validate()
        from escape_hw.io.fits.run_state import STATE_FILE, load_state

        path = resume / STATE_FILE
        if not path.is_file() and (resume / "report.html").is_file():
            raise ProductError(
                f"{resume} came to its end, there is nothing to go on with; its report is "
                f"{resume / 'report.html'}, and 'escape show {resume}' tells what it found"
            )
        if not path.is_file():
            raise ProductError(
                f"{path}: not there; {resume} is no run, it was broken off in its first seconds, or it came "
                "to its end"
            )
        return cls(**{**load_state(path).values["request"], **options}).validate()


class CalibrationTask:
    """A calibration by any method; see :class:`~escape_hw.runtime.procedures.task.Task`.

    Parameters
    ----------
    request
        What is asked for.
    resume
        Folder of a run to go on with.
    force
        Allow a simulated matrix on hardware.
    settings
        Keys of the configuration's section ``calibration`` to change; ``None``: as configured.
    """

    def __init__(
        self,
        request: CalibrationRequest,
        *,
        resume: Path | None = None,
        force: bool = False,
        settings: dict[str, object] | None = None,
    ) -> None:
        self.request = request
        self.kind = f"calibrate-{self.request.method}"
        self.overrides = set_overrides(
            {f"calibration.{key}": value for key, value in (settings or {}).items()}
        )
        self._resume, self._force = resume, force
        self._control_matrix: MatrixProduct | None = None
        self._checkpoint: Checkpoint | None = None

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.load`."""
        if self.request.closed_loop is not None:
            closed_loop = Path(self.request.closed_loop)
            self._control_matrix = load_fitting_matrix(closed_loop, config, self._force or simulated)

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[CalibrationResult]:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.procedure`."""
        from escape_hw.calibration.acquisition.checkpoint import Checkpoint
        from escape_hw.calibration.acquisition.stopping import Target
        from escape_hw.io.fits.run_state import STATE_FILE

        if self._control_matrix is not None:
            require_hardware_matrix(self._control_matrix, bench, self._force)
        source = None if self._resume is None else self._resume / STATE_FILE
        one = self.request
        # A short run cannot be resumed; escape() refuses to resume one.
        if source is not None or not self._is_short_run(bench):
            self._checkpoint = Checkpoint(folder.file(STATE_FILE), source, request=asdict(one))
        return calibrate_with_method(
            bench, one.method, frames=one.frames, poke=one.poke, whiten=not one.plain,
            estimator=one.estimator, closed_loop=None if self._control_matrix is None else self._control_matrix.result,
            checkpoint=self._checkpoint,
            until=None if one.snr is None and one.accuracy is None else Target(one.snr, one.accuracy),
        )  # fmt: skip

    def _is_short_run(self, bench: Bench) -> bool:
        """Whether the request is for an ESCAPE run of too few frames for a measured matrix."""
        if self.request.method != "escape":
            return False
        from escape_hw.calibration.escape.method import is_short_run

        c, closed_loop = bench.config, self._control_matrix
        n_modes = c.basis.n_modes if closed_loop is None else closed_loop.matrix.n_modes
        return is_short_run(
            c.calibration, n_modes, frames=self.request.frames, estimator=self.request.estimator
        )

    def save(
        self, folder: RunFolder, record: BenchRecord, result: CalibrationResult, wall_seconds: float
    ) -> SavedRun:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.save`."""
        from escape_hw.io.documents import calibration_document
        from escape_hw.paper.experiments import measured_calibration
        from escape_hw.runtime.procedures.products import add_calibration, write_run_result

        measured = measured_calibration(result)
        labels: dict[str, Any] = {"im": {"measured": "DO-CRIME", "column": ""}}
        parents = {} if self._control_matrix is None else {"closing": self._control_matrix.path}
        if measured is not None:
            parents = {"docrime": add_calibration(folder, record, "docrime", measured, parents)}
            labels["docrime"] = {"label": "DO-CRIME"}
        add_calibration(folder, record, "im", result, parents)
        checks = self._criteria(result)
        document = write_run_result(
            folder,
            {
                **record.header_fields("calibrate"),
                "title": f"Calibration of {record.system}",
                **calibration_document(result),
                "criteria": checks,
                "labels": labels,
                **record.footer_fields(wall_seconds),
            },
        )
        return SavedRun(document, all(entry["met"] for entry in checks))

    def _criteria(self, result: CalibrationResult) -> list[dict[str, Any]]:
        from escape_hw.runtime.procedures import criteria

        checks, one = [], self.request
        if result.matrix.method == "escape" and not result.partial:
            checks.append(criteria.sprint_converged("ESCAPE", result.registration))
        if one.accuracy is not None and result.registration is not None:
            worst = float(result.registration.sigma[:2].max())
            text = f"standard error of the shifts: {worst:.3g} (wanted {one.accuracy:g}) % of a sub-aperture"
            checks.append(criteria.criterion(text, worst <= one.accuracy))
        if one.snr is not None:
            least = float((result.measured or result.matrix).snr().min())
            text = f"signal-to-noise ratio of the weakest mode: {least:.3g} (wanted {one.snr:g})"
            checks.append(criteria.criterion(text, least >= one.snr))
        return checks

    def finish(self) -> None:
        """See :meth:`~escape_hw.runtime.procedures.task.Task.finish`."""
        if self._checkpoint is not None:
            self._checkpoint.remove()


def mode_count_overrides(config: SystemConfig, modes: int) -> tuple[tuple[str, ...], int]:
    """Overrides for another number of modes; the loop goes on dropping the same share of them.

    Returns
    -------
    overrides : tuple of str
    dropped : int
        Modes that the loop then drops.
    """
    configured_dropped, n = config.loop.dropped_modes, config.basis.n_modes
    dropped = min(configured_dropped, modes * configured_dropped // n)
    change = () if dropped == configured_dropped else (f"loop.dropped_modes={dropped}",)
    return (f"basis.n_modes={modes}", *change), dropped
