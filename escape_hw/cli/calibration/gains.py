"""``escape gains``."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.context import CommandContext, command_context

if TYPE_CHECKING:
    from escape_hw.calibration.optical_gain.bootstrap import GainsRun
    from escape_hw.runtime.session.record import BenchRecord


def gains(
    system: options.System,
    im: options.Matrix,
    poke: Annotated[
        float,
        typer.Option("--poke", help="Last poke of each mode, rms surface as a fraction of full stroke."),
    ] = 0.002,
    accuracy: Annotated[
        float, typer.Option("--accuracy", help="Relative standard error of the gains to go on for.")
    ] = 0.01,
    budget: Annotated[
        float, typer.Option("--budget", help="Share of the Strehl ratio that the last pokes may cost.")
    ] = 0.01,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames per round at most.")] = 20000,
    gain: Annotated[
        float | None, typer.Option("--gain", help="Effective gain of the loop (default: as configured).")
    ] = None,
    beside: Annotated[
        list[Path] | None,
        typer.Option("--beside", metavar="FILE", help="Another matrix whose gains are wanted; repeatable."),
    ] = None,
    strehl: Annotated[
        bool, typer.Option("--strehl/--no-strehl", help="Measure the model PSF and the Strehl ratios.")
    ] = True,
    force: options.Force = False,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Close the loop on a matrix of unknown scale and scale it to the turbulence, mode by mode."""
    with command_context("gains", json=json, quiet=quiet) as context:
        from escape_hw.runtime.procedures.gains import GainsTask

        wanted = {"poke": poke, "accuracy": accuracy, "budget": budget, "frames": frames, "gain": gain}
        task = GainsTask(im, beside=beside or (), strehl=strehl, force=force, options=wanted)
        context.run_task(
            task, options.SystemSelection.of(system, set, seed, mode), out, partial(_show, context)
        )


def _show(context: CommandContext, run: GainsRun, record: BenchRecord, document: dict[str, Any]) -> None:
    from escape_hw.cli.formatting import format_criteria, format_products, rich_table, status_line
    from escape_hw.report.tables import rounds_table

    result = run.result
    context.show(status_line(record.simulated, result.partial), rich_table(rounds_table(result)))
    context.show(
        *format_criteria(document["criteria"]), *result.notes, *format_products(document["products"])
    )
