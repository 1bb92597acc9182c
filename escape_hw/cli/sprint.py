"""``escape sprint``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.io.run_folder import RunFolder


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
    also: options.Also = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Find the registration behind a measured interaction matrix, and the matrix of the model there."""
    with session("sprint", json=json, quiet=quiet) as one:
        choice = options.Choice.of(system, set, seed, mode).calibrating(
            solver=solver, modes_choice=modes_choice, loss=loss, also=options.listed(also)
        )
        config = one.configured(choice)
        with one.run_folder(config, "sprint", out) as folder:
            _sprint(one, folder, config, im)


def _sprint(one: Session, folder: RunFolder, config: Any, im: Path) -> None:
    from dataclasses import replace

    from escape_hw.calibration.pseudo_synthetic import synthetic_of
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
        also=settings.also,
    )
    result = replace(product.result, matrix=measured, measured=None, registration=estimate)
    origin = replace(config_record(config), parents={im.name: product.sha256})
    folder.add("im", save_matrix(folder.file("im.fits"), result, origin))
    synthetic = synthetic_of(result, model, estimate)
    folder.add("escape", save_matrix(folder.file("escape.fits"), synthetic, origin))
    checks = [criteria.converged(im.name, estimate)]
    document = finish(
        folder,
        {
            **documents.head("sprint", measured.system, measured.simulated, config.system.seed),
            "title": f"Registration of {measured.system}",
            **documents.calibration_document(result),
            "criteria": checks,
            "labels": {"im": {"column": ""}, "escape": {"column": ""}},
            "finished_utc": utc_text(),
            "wall_seconds": one.wall_seconds,
        },
    )
    one.result(document, met=estimate.converged)
    one.show(bands(measured.simulated, False), rich_table(registration_table({"": estimate})))
    one.show(*checks_view(checks), *products_view(document["products"]))
