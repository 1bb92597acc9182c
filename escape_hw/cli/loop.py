"""``escape loop``."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.api.results import LoopResult
    from escape_hw.bench import Bench
    from escape_hw.config.models import SystemConfig
    from escape_hw.io.fits import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
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
        from escape_hw.errors import ConfigError
        from escape_hw.runtime.keep import keep_telemetry

        if best and gain is not None:
            raise ConfigError("--gain and --best-gain exclude each other")
        given = {"gain": gain, "leak": leak, "dropped_modes": drop}
        settings = [f"loop.{key}={value}" for key, value in given.items() if value is not None]
        choice = options.Choice.of(system, [*(set or []), *settings], seed, mode)
        config = one.configured(choice)
        product = fitting_matrix(im, config, force)
        with one.run_folder(config, "loop", out) as folder:
            with one.bench(choice) as bench:
                from escape_hw.runtime.records import BenchRecord
                from escape_hw.runtime.telemetry_tape import TelemetryTape

                refuse_simulated(product, bench, force)
                about = BenchRecord.of(bench)
                tape = TelemetryTape(record, product.grid.n_slopes, bench.dm.info.n_act) if record else None
                if tape is not None:
                    bench.taps = tape.taps
                result, stop = one.attempt(_procedure(bench, product, frames, best, strehl))
            with one.saving(stop):
                if tape is not None:
                    keep_telemetry(folder, about, "telemetry", tape.telemetry(), product.path)
                _finish(one, folder, about, product, result)
            if stop is not None:
                raise stop


def fitting_matrix(im: Any, config: SystemConfig, force: bool = False) -> MatrixProduct:
    """Read a matrix that belongs to this system, basis, mirror and mode.

    Raises
    ------
    ProductError, IncompatibleProduct
        It is damaged or belongs elsewhere.
    """
    from escape_hw.io.fits import load_matrix

    return load_matrix(
        im,
        expect_system=config.system.name,
        expect_sensor=config.sensor.kind,
        expect_basis=config.basis.kind,
        expect_modes=config.basis.n_modes,
        expect_actuators=config.devices.dm.n_act,
        allow_simulated=force or config.system.mode == "sim",
    )


def refuse_simulated(product: MatrixProduct, bench: Bench, force: bool) -> None:
    """Single devices may have a mode of their own: what was really opened decides."""
    from escape_hw.errors import IncompatibleProduct

    if product.matrix.simulated and not bench.simulated and not force:
        raise IncompatibleProduct(
            f"{product.path}: made in simulation; it is not for hardware (--force overrides)"
        )


def _procedure(
    bench: Bench, product: MatrixProduct, frames: int, best: bool, strehl: bool
) -> Procedure[LoopResult]:
    """Model PSF where the bench can take one, best gain when asked, then the loop itself."""
    from escape_hw.calibration.closed_loop import closed_loop
    from escape_hw.calibration.gain_search import best_gain
    from escape_hw.runtime.procedures import model_psf

    matrix, grid = product.matrix, product.grid
    model = gain = None
    if strehl and bench.science is not None:
        model = yield from model_psf(bench)
    if best:
        gain, runs = yield from best_gain(bench, matrix, grid, model_psf=model)
        stopped = [run for run in runs if run.partial]
        if stopped:
            return stopped[-1]
    return (yield from closed_loop(bench, matrix, grid, gain=gain, frames=frames, model_psf=model))


def _finish(
    one: Session, folder: RunFolder, record: BenchRecord, product: MatrixProduct, result: LoopResult
) -> None:
    from escape_hw.cli.views import bands, products_view, rich_table
    from escape_hw.io.documents import loop_document
    from escape_hw.report.content import METHOD_LABELS
    from escape_hw.report.tables import strehl_table
    from escape_hw.runtime import criteria
    from escape_hw.runtime.keep import finish, keep_loop

    label = METHOD_LABELS.get(result.method, result.method)
    keep_loop(folder, record, "loop", result, product.path)
    document = finish(
        folder,
        {
            **record.head("loop"),
            "title": f"Closed loop on {record.system}",
            **loop_document(result),
            "im": product.path.absolute(),
            "criteria": [] if result.partial else criteria.loops({label: result}),
            "labels": {"loop": {"label": label}},
            **record.tail(one.wall_seconds),
        },
    )
    one.result(document, met=result.stable)
    one.show(bands(record.simulated, result.partial), rich_table(strehl_table({label: result})))
    one.show(*result.notes, *products_view(document["products"]))
