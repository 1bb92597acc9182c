"""``escape track``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.loop import fitting_matrix, refuse_simulated
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.api.tracking import TrackResult
    from escape_hw.bench import Bench
    from escape_hw.io.fits import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
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
        given = {"tracking.poke": poke, "tracking.memory_s": memory, "loop.gain": gain}
        settings = [f"{key}={value}" for key, value in given.items() if value is not None]
        choice = options.Choice.of(system, [*(set or []), *settings], seed, mode)
        config = one.configured(choice)
        product = fitting_matrix(im, config, force)
        with one.run_folder(config, "track", out) as folder:
            with one.bench(choice) as bench:
                from escape_hw.runtime.records import BenchRecord

                refuse_simulated(product, bench, force)
                record = BenchRecord.of(bench)
                result, stop = one.attempt(_procedure(bench, product, seconds, not propose, strehl))
            with one.saving(stop):
                _finish(one, folder, record, product, result)
            if stop is not None:
                raise stop


def _procedure(
    bench: Bench, product: MatrixProduct, seconds: float, exchange: bool, strehl: bool
) -> Procedure[TrackResult]:
    """Model PSF where the bench can take one, then the tracker."""
    from escape_hw.calibration.track import track as follow
    from escape_hw.runtime.procedures import model_psf

    psf = (yield from model_psf(bench)) if strehl and bench.science is not None else None
    return (
        yield from follow(
            bench, product.matrix, product.grid, seconds=seconds, registration=product.registration,
            response=product.result.response, exchange=exchange, model_psf=psf,
        )
    )  # fmt: skip


def _finish(
    one: Session, folder: RunFolder, record: BenchRecord, product: MatrixProduct, result: TrackResult
) -> None:
    from escape_hw.cli.views import bands, products_view
    from escape_hw.io.track_document import track_document
    from escape_hw.runtime.keep import finish, keep_calibration

    folder.add("table", folder.write_text("track.csv", result.to_csv()))
    if result.latest is not None:
        keep_calibration(folder, record, "im", result.latest, {"im": product.path})
    document = finish(
        folder,
        {
            **record.head("track"),
            "title": f"Tracking {record.system}",
            **track_document(result),
            "im": product.path.absolute(),
            "criteria": [
                {"text": "loop stable", "met": result.stable},
                {"text": f"no alarms ({len(result.alarms)})", "met": not result.alarms},
            ],
            **record.tail(one.wall_seconds),
        },
    )
    one.result(document, met=result.stable and not result.alarms)
    one.show(bands(record.simulated, result.partial))
    for name, found in document["registration"].items():
        one.show(f"{name}: {found['value']:.3f} ± {found['sigma']:.3f} {found['unit']}")
    if result.optical_gain.size:
        value, sigma = result.optical_gain.mean(), result.optical_gain_sigma.mean()
        one.show(f"optical gain beside the first matrix: {value:.3f} ± {sigma:.3f}")
    accepted = sum(exchange.accepted for exchange in result.exchanges)
    one.show(f"{len(result.exchanges)} matrices proposed, {accepted} exchanged")
    one.show(*(f"alarm after {alarm.seconds:.0f} s: {alarm.text}" for alarm in result.alarms))
    one.show(*products_view(document["products"]))
