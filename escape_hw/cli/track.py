"""``escape track``."""

from __future__ import annotations

from functools import partial
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.tracking import TrackResult
    from escape_hw.runtime.records import BenchRecord


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
    with session("track", json=json, quiet=quiet) as one:
        from escape_hw.runtime.track_task import TrackTask

        task = TrackTask(
            im, seconds=seconds, poke=poke, memory=memory, gain=gain, exchange=not propose, strehl=strehl,
            force=force,
        )  # fmt: skip
        one.perform(task, options.Choice.of(system, set, seed, mode), out, partial(_show, one))


def _show(one: Session, result: TrackResult, record: BenchRecord, document: dict[str, Any]) -> None:
    from escape_hw.api.registration import Registration
    from escape_hw.api.results import Measured
    from escape_hw.cli.views import bands, products_view, rich_table
    from escape_hw.report.tables import parameters_table

    one.show(bands(record.simulated, result.partial))
    found = {name: Measured(**value) for name, value in document["registration"].items()}
    if found:
        planted = Registration(**document["planted_end"]) if document["planted_end"] else None
        one.show(rich_table(parameters_table({"": found}, planted)))
    if document["planted_note"]:
        one.show(document["planted_note"])
    if result.optical_gain.size:
        value, sigma = result.optical_gain.mean(), result.optical_gain_sigma.mean()
        one.show(f"optical gain beside the first matrix: {value:.3f} ± {sigma:.3f}")
    accepted = sum(exchange.accepted for exchange in result.exchanges)
    one.show(f"{len(result.exchanges)} matrices proposed, {accepted} exchanged")
    one.show(*(f"alarm after {alarm.seconds:.0f} s: {alarm.text}" for alarm in result.alarms))
    one.show(*products_view(document["products"]))
