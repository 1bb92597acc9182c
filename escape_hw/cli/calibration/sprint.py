"""``escape sprint``."""

from __future__ import annotations

from typing import TYPE_CHECKING

from escape_hw.cli import options
from escape_hw.cli.context import CommandContext, command_context

if TYPE_CHECKING:
    from escape_hw.api.results import CalibrationResult
    from escape_hw.runtime.procedures.task import SavedRun


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
    also: options.ExtraParameters = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Find the registration behind a measured interaction matrix, and the matrix of the model there."""
    with command_context("sprint", json=json, quiet=quiet) as context:
        from escape_hw.runtime.procedures.sprint import SprintTask

        selection = options.SystemSelection.of(system, set, seed, mode).with_calibration_settings(
            solver=solver, modes_choice=modes_choice, loss=loss, extra_parameters=options.as_toml_list(also)
        )
        config = context.load_config(selection)
        task = SprintTask(im)
        with context.run_folder(config, "sprint", out) as folder:
            task.load(config)
            result = context.run(task.fit())
            kept = task.save_fit(folder, result, context.wall_seconds)
        _show(context, result, kept)


def _show(context: CommandContext, result: CalibrationResult, kept: SavedRun) -> None:
    from escape_hw.cli.formatting import format_criteria, format_products, rich_table, status_line
    from escape_hw.report.tables import registration_table

    context.result(kept.document, met=kept.met)
    estimate = result.registration
    if estimate is not None:
        context.show(
            status_line(result.matrix.simulated, False), rich_table(registration_table({"": estimate}))
        )
    context.show(*format_criteria(kept.document["criteria"]), *format_products(kept.document["products"]))
