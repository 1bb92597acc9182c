"""``escape track``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.context import CommandContext, command_context

if TYPE_CHECKING:
    from escape_hw.api.tracking import TrackResult
    from escape_hw.runtime.session.record import BenchRecord


def track(
    system: options.System,
    im: options.Matrix,
    seconds: Annotated[float, typer.Option("--seconds", min=1, help="How long.")] = 60.0,
    poke: Annotated[
        float | None,
        typer.Option("--poke", min=0, help="Pokes, rms surface as fraction of full stroke."),
    ] = None,
    memory: Annotated[
        float | None,
        typer.Option("--memory", min=1, help="Seconds in which old frames fade (default: as configured)."),
    ] = None,
    gain: Annotated[
        float | None, typer.Option("--gain", min=0, max=2, help="Gain (default: as configured).")
    ] = None,
    propose: Annotated[
        bool, typer.Option("--propose", help="Only propose new matrices, exchange none.")
    ] = False,
    strehl: Annotated[
        bool, typer.Option("--strehl/--no-strehl", help="Measure the model PSF and follow the Strehl ratio.")
    ] = True,
    force: options.Force = False,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Close the loop and follow what drifts: registration, optical gains, matrix."""
    with command_context("track", json=json, quiet=quiet) as context:
        from escape_hw.runtime.procedures.track import TrackTask

        task = TrackTask(
            im, seconds=seconds, poke=poke, memory=memory, gain=gain, exchange=not propose, strehl=strehl,
            force=force,
        )  # fmt: skip
        context.run_task(
            task, options.SystemSelection.of(system, set, seed, mode), out, partial(_show, context)
        )


def _show(
    context: CommandContext, result: TrackResult, record: BenchRecord, document: dict[str, Any]
) -> None:
    from escape_hw.api.registration import Registration
    from escape_hw.api.results import Estimate
    from escape_hw.cli.formatting import format_products, rich_table, status_line
    from escape_hw.report.tables import parameters_table

    context.show(status_line(record.simulated, result.partial))
    found = {name: Estimate(**value) for name, value in document["registration"].items()}
    if found:
        injected = Registration(**document["injected_end"]) if document["injected_end"] else None
        context.show(rich_table(parameters_table({"": found}, injected)))
    if document["injected_note"]:
        context.show(document["injected_note"])
    if result.optical_gain.size:
        value, sigma = result.optical_gain.mean(), result.optical_gain_sigma.mean()
        context.show(f"optical gain beside the first matrix: {value:.3f} ± {sigma:.3f}")
    accepted = sum(exchange.accepted for exchange in result.exchanges)
    context.show(f"{len(result.exchanges)} matrices proposed, {accepted} exchanged")
    context.show(*(f"alarm after {alarm.seconds:.0f} s: {alarm.text}" for alarm in result.alarms))
    context.show(*format_products(document["products"]))
