"""``escape gains``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.loop import fitting_matrix, refuse_simulated
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.matrix import InteractionMatrix
    from escape_hw.api.procedure import Procedure
    from escape_hw.bench import Bench
    from escape_hw.calibration.gain_bootstrap import GainsRun
    from escape_hw.io.fits import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord


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
    with session("gains", json=json, quiet=quiet) as one:
        choice = options.Choice.of(system, set, seed, mode)
        config = one.configured(choice)
        product = fitting_matrix(im, config, force)
        others = {path.stem: fitting_matrix(path, config, force) for path in beside or []}
        with one.run_folder(config, "gains", out) as folder:
            with one.bench(choice) as bench:
                from escape_hw.runtime.records import BenchRecord

                for each in (product, *others.values()):
                    refuse_simulated(each, bench, force)
                record = BenchRecord.of(bench)
                procedure = _procedure(bench, product, others, poke, accuracy, budget, frames, gain, strehl)
                result, stop = one.attempt(procedure)
            with one.saving(stop):
                _finish(one, folder, record, product, others, result)
            if stop is not None:
                raise stop


def _procedure(
    bench: Bench,
    product: MatrixProduct,
    others: dict[str, MatrixProduct],
    poke: float,
    accuracy: float,
    budget: float,
    frames: int,
    gain: float | None,
    strehl: bool,
) -> Procedure[GainsRun]:
    """Model PSF where the bench can take one, then the bootstrap."""
    from escape_hw.calibration.gain_bootstrap import bootstrap_gains
    from escape_hw.runtime.procedures import model_psf

    model = None
    if strehl and bench.science is not None:
        model = yield from model_psf(bench)
    return (
        yield from bootstrap_gains(
            bench,
            product.result,
            poke=poke,
            accuracy=accuracy,
            budget=budget,
            frames=frames,
            gain=gain,
            beside=_beside(product, others),
            model_psf=model,
        )
    )


def _beside(product: MatrixProduct, others: dict[str, MatrixProduct]) -> dict[str, InteractionMatrix]:
    """The other matrices, and the measured one that a pseudo-synthetic one was computed from."""
    measured = product.result.measured
    known = {} if measured is None else {"DO-CRIME": measured}
    return {**known, **{name: each.matrix for name, each in others.items()}}


def _finish(
    one: Session,
    folder: RunFolder,
    record: BenchRecord,
    product: MatrixProduct,
    others: dict[str, MatrixProduct],
    run: GainsRun,
) -> None:
    from escape_hw.cli.views import bands, checks_view, products_view, rich_table
    from escape_hw.io.documents import gains_document
    from escape_hw.report.tables import rounds_table
    from escape_hw.runtime import criteria
    from escape_hw.runtime.keep import finish, keep_calibration, keep_gains

    result, parents = run.result, {"im": product.path, **{name: each.path for name, each in others.items()}}
    keep_gains(folder, record, "gains", result, parents)
    if result.rounds:
        keep_calibration(folder, record, "im", run.rescaled, {"im": product.path})
    checks = [] if result.partial else [criteria.gains_converged(result)]
    document = finish(
        folder,
        {
            **record.head("gains"),
            "title": f"Optical gains of {record.system}",
            **gains_document(result),
            "im": product.path.absolute(),
            "criteria": checks,
            "labels": {"im": {"label": "rescaled", "column": ""}},
            **record.tail(one.wall_seconds),
        },
    )
    one.result(document, met=result.converged)
    one.show(bands(record.simulated, result.partial), rich_table(rounds_table(result)))
    one.show(*checks_view(checks), *result.notes, *products_view(document["products"]))
