"""``escape loop``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.context import CommandContext, command_context

if TYPE_CHECKING:
    from escape_hw.api.results import LoopResult
    from escape_hw.runtime.session.record import BenchRecord


def loop(
    system: options.System,
    im: options.Matrix,
    gain: Annotated[
        float | None, typer.Option("--gain", min=0, max=2, help="Gain (default: as configured).")
    ] = None,
    leak: Annotated[
        float | None, typer.Option("--leak", min=0, max=1, help="Leak per frame (default: as configured).")
    ] = None,
    dropped_modes: Annotated[
        int | None, typer.Option("--drop", min=0, help="Eigenmodes left out (default: as configured).")
    ] = None,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames to run.")] = 5000,
    best: Annotated[bool, typer.Option("--best-gain", help="Look for the best gain first.")] = False,
    strehl: Annotated[
        bool, typer.Option("--strehl/--no-strehl", help="Measure the model PSF and the Strehl ratios.")
    ] = True,
    record: Annotated[
        int, typer.Option("--record", min=0, help="Keep slopes and commands of the newest so many frames.")
    ] = 0,
    force: options.Force = False,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Close the loop with an interaction matrix."""
    with command_context("loop", json=json, quiet=quiet) as context:
        from escape_hw.runtime.procedures.loop import LoopTask

        task = LoopTask(
            im, frames=frames, gain=gain, leak=leak, dropped_modes=dropped_modes, best=best, strehl=strehl,
            record=record, force=force,
        )  # fmt: skip
        context.run_task(
            task, options.SystemSelection.of(system, set, seed, mode), out, partial(_show, context)
        )


def _show(context: CommandContext, result: LoopResult, record: BenchRecord, document: dict[str, Any]) -> None:
    from escape_hw.cli.formatting import format_products, rich_table, status_line
    from escape_hw.report.tables import METHOD_LABELS, strehl_table

    label = METHOD_LABELS.get(result.method, result.method)
    context.show(status_line(record.simulated, result.partial), rich_table(strehl_table({label: result})))
    context.show(*result.notes, *format_products(document["products"]))
