"""``escape sprint``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.results import CalibrationResult
    from escape_hw.runtime.task import Kept


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
        from escape_hw.runtime.sprint_task import SprintTask

        choice = options.Choice.of(system, set, seed, mode).calibrating(
            solver=solver, modes_choice=modes_choice, loss=loss, also=options.listed(also)
        )
        config = one.configured(choice)
        task = SprintTask(im)
        with one.run_folder(config, "sprint", out) as folder:
            task.load(config)
            result = one.run(task.fit())
            kept = task.save(folder, result, one.wall_seconds)
        _show(one, result, kept)


def _show(one: Session, result: CalibrationResult, kept: Kept) -> None:
    from escape_hw.cli.views import bands, checks_view, products_view, rich_table
    from escape_hw.report.tables import registration_table

    one.result(kept.document, met=kept.met)
    estimate = result.registration
    if estimate is not None:
        one.show(bands(result.matrix.simulated, False), rich_table(registration_table({"": estimate})))
    one.show(*checks_view(kept.document["criteria"]), *products_view(kept.document["products"]))
