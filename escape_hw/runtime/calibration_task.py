"""Calibrating, from the request to the kept matrix."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.api.procedure import Procedure
from escape_hw.api.results import CalibrationResult
from escape_hw.errors import ConfigError, ProductError
from escape_hw.runtime.task import Kept, fitting_matrix, given, refuse_simulated

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.calibration.checkpoint import Checkpoint
    from escape_hw.config.models import SystemConfig
    from escape_hw.io.fits import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


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

    def checked(self) -> CalibrationRequest:
        """The request, if its parts go together.

        Raises
        ------
        ConfigError
            They do not; nothing was opened.
        """
        from escape_hw.config.models import ESTIMATORS
        from escape_hw.runtime.procedures import CLOSED_LOOP, METHODS

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
    def of(cls, asked: Mapping[str, Any], resume: Path | None = None) -> CalibrationRequest:
        """What is asked for, with what the run to resume was asked for where nothing (``None``) is said.

        Raises
        ------
        ConfigError
            Its parts do not go together.
        ProductError
            There is nothing to resume.
        """
        said = {key: value for key, value in asked.items() if value is not None}
        if resume is None:
            return cls(**said).checked()
        from escape_hw.io.state_file import STATE, load_state

        path = resume / STATE
        if not path.is_file():
            raise ProductError(
                f"{path}: not there; {resume} is no run, it was broken off in its first seconds, or it came "
                "to its end"
            )
        return cls(**{**load_state(path).values["request"], **said}).checked()


class CalibrationTask:
    """A calibration by any method; see :class:`~escape_hw.runtime.task.Task`.

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
        self.overrides = given({f"calibration.{key}": value for key, value in (settings or {}).items()})
        self._resume, self._force = resume, force
        self._closing: MatrixProduct | None = None
        self._keep: Checkpoint | None = None

    def load(self, config: SystemConfig, simulated: bool = False) -> None:
        """See :meth:`~escape_hw.runtime.task.Task.load`."""
        if self.request.closed_loop is not None:
            closed_loop = Path(self.request.closed_loop)
            self._closing = fitting_matrix(closed_loop, config, self._force or simulated)

    def procedure(self, bench: Bench, folder: RunFolder) -> Procedure[CalibrationResult]:
        """See :meth:`~escape_hw.runtime.task.Task.procedure`."""
        from escape_hw.calibration.checkpoint import Checkpoint
        from escape_hw.calibration.stopping import Target
        from escape_hw.io.state_file import STATE
        from escape_hw.runtime.procedures import calibrate_by

        if self._closing is not None:
            refuse_simulated(self._closing, bench, self._force)
        source = None if self._resume is None else self._resume / STATE
        self._keep = Checkpoint(folder.file(STATE), source, request=asdict(self.request))
        one = self.request
        return calibrate_by(
            bench, one.method, frames=one.frames, poke=one.poke, whiten=not one.plain,
            estimator=one.estimator, closing=None if self._closing is None else self._closing.result,
            keep=self._keep,
            until=None if one.snr is None and one.accuracy is None else Target(one.snr, one.accuracy),
        )  # fmt: skip

    def keep(
        self, folder: RunFolder, record: BenchRecord, result: CalibrationResult, wall_seconds: float
    ) -> Kept:
        """See :meth:`~escape_hw.runtime.task.Task.keep`."""
        from escape_hw.io.documents import calibration_document
        from escape_hw.runtime.keep import finish, keep_calibration
        from escape_hw.runtime.reproduce import measured_part

        measured = measured_part(result)
        labels: dict[str, Any] = {"im": {"measured": "DO-CRIME", "column": ""}}
        parents = {} if self._closing is None else {"closing": self._closing.path}
        if measured is not None:
            parents = {"docrime": keep_calibration(folder, record, "docrime", measured, parents)}
            labels["docrime"] = {"label": "DO-CRIME"}
        keep_calibration(folder, record, "im", result, parents)
        checks = self._checks(result)
        document = finish(
            folder,
            {
                **record.head("calibrate"),
                "title": f"Calibration of {record.system}",
                **calibration_document(result),
                "criteria": checks,
                "labels": labels,
                **record.tail(wall_seconds),
            },
        )
        return Kept(document, all(entry["met"] for entry in checks))

    def _checks(self, result: CalibrationResult) -> list[dict[str, Any]]:
        from escape_hw.runtime import criteria

        checks, one = [], self.request
        if result.matrix.method == "escape" and not result.partial:
            checks.append(criteria.converged("ESCAPE", result.registration))
        if one.accuracy is not None and result.registration is not None:
            worst = float(result.registration.sigma[:2].max())
            text = f"standard error of the shifts: {worst:.3g} (wanted {one.accuracy:g}) % of a sub-aperture"
            checks.append(criteria.check(text, worst <= one.accuracy))
        if one.snr is not None:
            least = float((result.measured or result.matrix).snr().min())
            text = f"signal-to-noise ratio of the weakest mode: {least:.3g} (wanted {one.snr:g})"
            checks.append(criteria.check(text, least >= one.snr))
        return checks

    def done(self) -> None:
        """See :meth:`~escape_hw.runtime.task.Task.done`."""
        if self._keep is not None:
            self._keep.done()


def with_modes(config: SystemConfig, modes: int) -> tuple[tuple[str, ...], int]:
    """Overrides for another number of modes; the loop goes on dropping the same share of them.

    Returns
    -------
    overrides : tuple of str
    dropped : int
        Modes that the loop then drops.
    """
    usual, n = config.loop.dropped_modes, config.basis.n_modes
    dropped = min(usual, modes * usual // n)
    change = () if dropped == usual else (f"loop.dropped_modes={dropped}",)
    return (f"basis.n_modes={modes}", *change), dropped
