"""``escape loop``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.results import LoopResult
    from escape_hw.runtime.records import BenchRecord


def loop(
    system: options.System,
    im: options.Matrix,
    gain: Annotated[
        float | None, typer.Option("--gain", min=0, max=2, help="Gain (default: as configured).")
    ] = None,
    leak: Annotated[
        float | None, typer.Option("--leak", min=0, max=1, help="Leak per frame (default: as configured).")
    ] = None,
    drop: Annotated[
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
    with session("loop", json=json, quiet=quiet) as one:
        from escape_hw.runtime.loop_task import LoopTask

        task = LoopTask(
            im, frames=frames, gain=gain, leak=leak, dropped_modes=drop, best=best, strehl=strehl,
            record=record, force=force,
        )  # fmt: skip
        one.perform(task, options.Choice.of(system, set, seed, mode), out, partial(_show, one))


def _show(one: Session, result: LoopResult, record: BenchRecord, document: dict[str, Any]) -> None:
    from escape_hw.cli.views import bands, products_view, rich_table
    from escape_hw.report.tables import METHOD_LABELS, strehl_table

    label = METHOD_LABELS.get(result.method, result.method)
    one.show(bands(record.simulated, result.partial), rich_table(strehl_table({label: result})))
    one.show(*result.notes, *products_view(document["products"]))
