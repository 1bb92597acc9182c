"""``escape calibrate`` and ``escape sprint``."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.api.results import CalibrationResult
    from escape_hw.bench import Bench
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


def calibrate(
    system: options.System,
    method: Annotated[
        str, typer.Option("--method", help="push-pull, modulated, docrime or escape.")
    ] = "escape",
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
        typer.Option("--accuracy", help="Exit 1 unless the shifts are known to this % of a sub-aperture."),
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
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Measure an interaction matrix and, with ESCAPE, the registration behind it."""
    with session("calibrate", json=json, quiet=quiet) as one:
        choice = options.Choice.of(system, set, seed, mode).calibrating(
            pokes=pokes, solver=solver, modes_choice=modes_choice, loss=loss
        )
        if modes is not None:
            choice = _with_modes(one, choice, modes)
        config = one.configured(choice)
        start = _procedure(method, frames, poke, accuracy, plain, estimator)
        with one.run_folder(config, f"calibrate-{method}", out) as folder:
            with one.bench(choice) as bench:
                from escape_hw.runtime.records import BenchRecord

                record = BenchRecord.of(bench)
                result, stop = one.attempt(start(bench))
            with one.saving(stop):
                _finish(one, folder, record, result, accuracy)
            if stop is not None:
                raise stop


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


def _procedure(
    method: str,
    frames: int | None,
    poke: float | None,
    accuracy: float | None,
    plain: bool,
    estimator: str | None,
) -> Callable[[Bench], Procedure[CalibrationResult]]:
    """The chosen procedure; refuses what does not go together before anything is opened."""
    from escape_hw.config.models import ESTIMATORS
    from escape_hw.errors import ConfigError
    from escape_hw.runtime.procedures import METHODS, calibrate_by

    if method not in METHODS:
        raise ConfigError(f"--method {method}: unknown; it is one of {', '.join(METHODS)}")
    if poke is not None and not 0 < poke <= 1:
        raise ConfigError(f"--poke {poke:g}: it must lie in (0, 1], a fraction of full stroke")
    if accuracy is not None and (method != "escape" or not accuracy > 0):
        raise ConfigError("--accuracy: it goes with --method escape and must be positive")
    if plain and method != "docrime":
        raise ConfigError("--plain: it goes with --method docrime")
    if estimator is not None and (method != "escape" or estimator not in ESTIMATORS):
        raise ConfigError(
            f"--estimator {estimator}: it goes with --method escape and is one of {', '.join(ESTIMATORS)}"
        )
    return lambda bench: calibrate_by(
        bench, method, frames=frames, poke=poke, whiten=not plain, estimator=estimator
    )


def _finish(
    one: Session, folder: RunFolder, record: BenchRecord, result: CalibrationResult, accuracy: float | None
) -> None:
    """Save, judge, report and show a calibration."""
    from escape_hw.io.documents import calibration_document
    from escape_hw.runtime import criteria
    from escape_hw.runtime.keep import finish, keep_calibration
    from escape_hw.runtime.reproduce import measured_part

    measured = measured_part(result)
    labels: dict[str, Any] = {"im": {"measured": "DO-CRIME", "column": ""}}
    parents = {}
    if measured is not None:
        parents = {"docrime": keep_calibration(folder, record, "docrime", measured)}
        labels["docrime"] = {"label": "DO-CRIME"}
    keep_calibration(folder, record, "im", result, parents)
    checks = []
    if result.matrix.method == "escape" and not result.partial:
        checks.append(criteria.converged("ESCAPE", result.registration))
    if accuracy is not None and result.registration is not None:
        worst = float(result.registration.sigma[:2].max())
        text = f"standard error of the shifts: {worst:.3g} (wanted {accuracy:g}) % of a sub-aperture"
        checks.append(criteria.check(text, worst <= accuracy))
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


def sprint(
    system: options.System,
    im: options.Matrix,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    solver: options.Solver = None,
    modes_choice: options.ModesChoice = None,
    loss: options.Loss = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Find the registration behind a measured interaction matrix; opens no device."""
    with session("sprint", json=json, quiet=quiet) as one:
        choice = options.Choice.of(system, set, seed, mode).calibrating(
            solver=solver, modes_choice=modes_choice, loss=loss
        )
        config = one.configured(choice)
        with one.run_folder(config, "sprint", out) as folder:
            _sprint(one, folder, config, im)


def _sprint(one: Session, folder: RunFolder, config: Any, im: Path) -> None:
    from dataclasses import replace

    from escape_hw.calibration.sprint import sprint
    from escape_hw.cli.views import bands, checks_view, products_view, rich_table
    from escape_hw.config.registry import model_factory
    from escape_hw.io import documents
    from escape_hw.io.fits import load_matrix, save_matrix
    from escape_hw.io.provenance import utc_text
    from escape_hw.report.tables import registration_table
    from escape_hw.runtime import criteria
    from escape_hw.runtime.keep import finish
    from escape_hw.runtime.records import config_record

    product = load_matrix(
        im,
        expect_system=config.system.name,
        expect_sensor=config.sensor.kind,
        expect_actuators=config.devices.dm.n_act,
    )
    measured = product.result.measured or product.matrix
    model = model_factory(config.calibration.model)(config, product.grid)
    settings = config.calibration
    estimate = sprint(
        measured,
        model,
        modes=min(settings.sprint_modes, measured.n_modes),
        choice=settings.modes_choice,
        solver=settings.solver,
        loss=settings.loss,
        learning_rate=settings.learning_rate,
    )
    result = replace(product.result, matrix=measured, measured=None, registration=estimate)
    origin = replace(config_record(config), parents={im.name: product.sha256})
    folder.add("im", save_matrix(folder.file("im.fits"), result, origin))
    checks = [criteria.converged(im.name, estimate)]
    document = finish(
        folder,
        {
            **documents.head("sprint", measured.system, measured.simulated, config.system.seed),
            "title": f"Registration of {measured.system}",
            **documents.calibration_document(result),
            "criteria": checks,
            "labels": {"im": {"column": ""}},
            "finished_utc": utc_text(),
            "wall_seconds": one.wall_seconds,
        },
    )
    one.result(document, met=estimate.converged)
    one.show(bands(measured.simulated, False), rich_table(registration_table({"": estimate})))
    one.show(*checks_view(checks), *products_view(document["products"]))
