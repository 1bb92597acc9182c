"""``escape calibrate`` and ``escape sprint``."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.loop import fitting_matrix, refuse_simulated
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.api.results import CalibrationResult
    from escape_hw.bench import Bench
    from escape_hw.calibration.checkpoint import Checkpoint
    from escape_hw.io.fits import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


@dataclass(frozen=True, slots=True)
class _Request:
    """How a calibration is asked for; kept with its state, so that it can be resumed without asking again."""

    method: str = "escape"
    frames: int | None = None
    poke: float | None = None
    accuracy: float | None = None
    snr: float | None = None
    plain: bool = False
    estimator: str | None = None
    closed_loop: str | None = None

    def checked(self) -> _Request:
        """The request, if its parts go together; otherwise it is refused before anything is opened."""
        from escape_hw.config.models import ESTIMATORS
        from escape_hw.errors import ConfigError
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

    def procedure(
        self, bench: Bench, closing: CalibrationResult | None, keep: Checkpoint
    ) -> Procedure[CalibrationResult]:
        """The procedure that does it."""
        from escape_hw.calibration.stopping import Target
        from escape_hw.runtime.procedures import calibrate_by

        asked = self.snr is not None or self.accuracy is not None
        return calibrate_by(
            bench, self.method, frames=self.frames, poke=self.poke, whiten=not self.plain,
            estimator=self.estimator, closing=closing, keep=keep,
            until=Target(self.snr, self.accuracy) if asked else None,
        )  # fmt: skip


def calibrate(
    system: Annotated[
        str | None,
        typer.Argument(help="Name of a system (see 'escape systems') or a TOML file; not with --resume."),
    ] = None,
    method: Annotated[
        str | None,
        typer.Option(
            "--method", help="push-pull, push-pull-fast, modulated, docrime or escape (the default)."
        ),
    ] = None,
    frames: Annotated[
        int | None,
        typer.Option("--frames", min=1, help="Frames (push-pull: per push and pull; modulated: per batch)."),
    ] = None,
    poke: Annotated[
        float | None, typer.Option("--poke", help="Poke, rms surface as a fraction of full stroke.")
    ] = None,
    modes: Annotated[int | None, typer.Option("--modes", min=1, help="Number of modes.")] = None,
    accuracy: Annotated[
        float | None,
        typer.Option(
            "--accuracy", help="Stop when the shifts are known to this % of a sub-aperture; else exit 1."
        ),
    ] = None,
    snr: Annotated[
        float | None,
        typer.Option("--snr", help="Stop when every mode has this signal-to-noise ratio; else exit 1."),
    ] = None,
    closed_loop: Annotated[
        Path | None,
        typer.Option("--closed-loop", metavar="FILE", help="Measure in closed loop, with this matrix."),
    ] = None,
    plain: Annotated[
        bool, typer.Option("--plain", help="The paper's estimator, turbulence not whitened (docrime).")
    ] = False,
    estimator: Annotated[
        str | None,
        typer.Option("--estimator", help="What ESCAPE fits: auto, matrix or telemetry (few frames)."),
    ] = None,
    pokes: options.Pokes = None,
    solver: options.Solver = None,
    modes_choice: options.ModesChoice = None,
    loss: options.Loss = None,
    resume: Annotated[
        Path | None,
        typer.Option("--resume", metavar="RUN", help="Go on with a run that was broken off (its folder)."),
    ] = None,
    force: options.Force = False,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Measure an interaction matrix and, with ESCAPE, the registration behind it."""
    with session("calibrate", json=json, quiet=quiet) as one:
        asked = {
            "method": method, "frames": frames, "poke": poke, "accuracy": accuracy, "snr": snr,
            "plain": plain or None, "estimator": estimator,
            "closed_loop": None if closed_loop is None else str(closed_loop.absolute()),
        }  # fmt: skip
        request = _request(asked, resume).checked()
        choice = options.Choice.of(_system(system, resume), set, seed, mode).calibrating(
            pokes=pokes, solver=solver, modes_choice=modes_choice, loss=loss
        )
        if modes is not None:
            choice = _with_modes(one, choice, modes)
        config = one.configured(choice)
        closing = None
        if request.closed_loop is not None:
            closing = fitting_matrix(request.closed_loop, config, force)
        with one.run_folder(config, f"calibrate-{request.method}", out) as folder:
            keep = _checkpoint(folder, request, resume)
            with one.bench(choice) as bench:
                from escape_hw.runtime.records import BenchRecord

                if closing is not None:
                    refuse_simulated(closing, bench, force)
                record = BenchRecord.of(bench)
                used = None if closing is None else closing.result
                result, stop = one.attempt(request.procedure(bench, used, keep))
            with one.saving(stop):
                _finish(one, folder, record, result, request, closing)
            if stop is not None:
                raise stop
            keep.done()


def _request(asked: dict[str, Any], resume: Path | None) -> _Request:
    """What is asked for, with what the run to resume was asked for where nothing is said."""
    given = {key: value for key, value in asked.items() if value is not None}
    if resume is None:
        return _Request(**given)
    from escape_hw.errors import ProductError
    from escape_hw.io.state_file import STATE, load_state

    path = resume / STATE
    if not path.is_file():
        raise ProductError(
            f"{path}: not there; {resume} is no run, it was broken off in its first seconds, or it came to "
            "its end"
        )
    return _Request(**{**load_state(path).values["request"], **given})


def _system(system: str | None, resume: Path | None) -> str:
    """The system that is named, or the configuration of the run to resume."""
    from escape_hw.errors import ConfigError

    if system is not None:
        return system
    if resume is None:
        raise ConfigError("which system? Name one (see 'escape systems'), or a run with --resume")
    return str(resume / "config.toml")


def _checkpoint(folder: RunFolder, request: _Request, resume: Path | None) -> Checkpoint:
    from escape_hw.calibration.checkpoint import Checkpoint
    from escape_hw.io.state_file import STATE

    source = None if resume is None else resume / STATE
    return Checkpoint(folder.file(STATE), source, request=asdict(request))


def _with_modes(one: Session, choice: options.Choice, modes: int) -> options.Choice:
    """The choice with another number of modes; the loop goes on dropping the same share of them.

    Who sets ``loop.dropped_modes`` gets what was set.
    """
    wanted = f"basis.n_modes={modes}"
    if any(text.partition("=")[0].strip() == "loop.dropped_modes" for text in choice.set):
        return choice.plus(wanted)
    usual = one.configured(choice)
    dropped = min(usual.loop.dropped_modes, modes * usual.loop.dropped_modes // usual.basis.n_modes)
    if dropped != usual.loop.dropped_modes:
        one.tell(f"loop.dropped_modes: {usual.loop.dropped_modes} becomes {dropped} with {modes} modes")
    return choice.plus(wanted, f"loop.dropped_modes={dropped}")


def _finish(
    one: Session,
    folder: RunFolder,
    record: BenchRecord,
    result: CalibrationResult,
    request: _Request,
    closing: MatrixProduct | None,
) -> None:
    """Save, judge, report and show a calibration."""
    from escape_hw.io.documents import calibration_document
    from escape_hw.runtime import criteria
    from escape_hw.runtime.keep import finish, keep_calibration
    from escape_hw.runtime.reproduce import measured_part

    measured = measured_part(result)
    labels: dict[str, Any] = {"im": {"measured": "DO-CRIME", "column": ""}}
    parents = {} if closing is None else {"closing": closing.path}
    if measured is not None:
        parents = {"docrime": keep_calibration(folder, record, "docrime", measured, parents)}
        labels["docrime"] = {"label": "DO-CRIME"}
    keep_calibration(folder, record, "im", result, parents)
    checks = []
    if result.matrix.method == "escape" and not result.partial:
        checks.append(criteria.converged("ESCAPE", result.registration))
    if request.accuracy is not None and result.registration is not None:
        worst = float(result.registration.sigma[:2].max())
        text = f"standard error of the shifts: {worst:.3g} (wanted {request.accuracy:g}) % of a sub-aperture"
        checks.append(criteria.check(text, worst <= request.accuracy))
    if request.snr is not None:
        least = float((result.measured or result.matrix).snr().min())
        text = f"signal-to-noise ratio of the weakest mode: {least:.3g} (wanted {request.snr:g})"
        checks.append(criteria.check(text, least >= request.snr))
    document = finish(
        folder,
        {
            **record.head("calibrate"),
            "title": f"Calibration of {record.system}",
            **calibration_document(result),
            "criteria": checks,
            "labels": labels,
            **record.tail(one.wall_seconds),
        },
    )
    one.result(document, met=all(entry["met"] for entry in checks))
    _show(one, record, result, document)


def _show(one: Session, record: BenchRecord, result: CalibrationResult, document: dict[str, Any]) -> None:
    from escape_hw.cli.views import bands, calibration_lines, checks_view, products_view, rich_table
    from escape_hw.report.tables import registration_table

    one.show(bands(record.simulated, result.partial), *calibration_lines(result))
    if result.registration is not None:
        one.show(rich_table(registration_table({"": result.registration}, record.planted)))
    one.show(*checks_view(document["criteria"]), *products_view(document["products"]))
