"""``escape sweep``."""

from __future__ import annotations

import inspect
import shlex
from collections.abc import Mapping, Sequence
from contextlib import closing, nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.api.optical_gains import GainsResult
    from escape_hw.bench import Bench
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.fits.matrix import MatrixProduct
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.session.record import BenchRecord
    from escape_hw.runtime.sweep.description import SweepDescription
    from escape_hw.runtime.sweep.design import Design, MatrixVariant
    from escape_hw.runtime.sweep.result import SweepResult
    from escape_hw.runtime.sweep.search_space import Parameter
    from escape_hw.runtime.sweep.workers import Workers


#: Arguments that a sweep to resume may have; all others describe a new one.
_RESUMABLE = {"resume", "workers", "scheduler", "storage", "out"}


@dataclass(frozen=True, slots=True)
class _Request:
    """A new sweep as its options say, with its files; without products, the matrices are measured first."""

    products: list[MatrixProduct]
    gains: GainsResult | None
    space: tuple[Parameter, ...]
    design: Design
    frames: int
    calibration_frames: int
    study: dict[str, Any]
    force: bool


@command("sweep", quiet=True)
def sweep(
    context: CommandContext,
    selection: options.OptionalSelection = options.NO_SYSTEM,
    im: Annotated[
        list[Path] | None,
        typer.Option(
            "--im", metavar="FILE", help="Matrix to compare; repeatable (default: measured beforehand)."
        ),
    ] = None,
    gains: Annotated[
        Path | None,
        typer.Option("--gains", metavar="FILE", help="Optical gains: compare with and without them."),
    ] = None,
    trials: Annotated[int, typer.Option("--trials", min=2, help="Loops with drawn parameters.")] = 200,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames of each loop.")] = 400,
    sampler: Annotated[
        str, typer.Option("--sampler", help="random (the same for every matrix), or tpe.")
    ] = "random",
    gain: Annotated[str | None, typer.Option("--gain", metavar="LOW:HIGH[:log]", help="Gain.")] = None,
    leak: Annotated[str | None, typer.Option("--leak", metavar="LOW:HIGH[:log]", help="Leak.")] = None,
    dropped_modes: Annotated[
        str | None, typer.Option("--dropped-modes", metavar="LOW:HIGH", help="Dropped modes.")
    ] = None,
    delay: Annotated[
        str | None, typer.Option("--delay", metavar="LOW:HIGH", help="Added delay in simulation, in frames.")
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(
            "--vary",
            metavar="KEY=LOW:HIGH[:log]",
            help="Any key of the configuration, also KEY=a,b,c; repeatable.",
        ),
    ] = None,
    metric: Annotated[
        str, typer.Option("--metric", help="Strehl ratio that is maximised: peak, otf or encircled.")
    ] = "peak",
    margin: Annotated[
        float, typer.Option("--margin", help="Largest difference that counts as equivalent, % Strehl.")
    ] = 1.0,
    candidates: Annotated[
        int, typer.Option("--candidates", min=1, help="Parameter sets of each matrix that run again.")
    ] = 3,
    replicates: Annotated[
        int, typer.Option("--replicates", min=1, help="Turbulence realisations they run on.")
    ] = 4,
    final_replicates: Annotated[
        int,
        typer.Option(
            "--final-replicates", min=6, help="Turbulence realisations for the best of each matrix."
        ),
    ] = 20,
    calibration_frames: Annotated[
        int | None,
        typer.Option("--calibration-frames", min=1, help="DO-CRIME frames (default: as configured)."),
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Parallel processes.")] = 2,
    scheduler: Annotated[
        str | None, typer.Option("--scheduler", metavar="ADDRESS", help="Run on a Dask scheduler's workers.")
    ] = None,
    storage: Annotated[
        str | None,
        typer.Option("--storage", metavar="URL", help="Storage of the trials (default: SQLite in the run)."),
    ] = None,
    study: Annotated[str, typer.Option("--study", help="Name of the study in the storage.")] = "sweep",
    resume: Annotated[
        Path | None,
        typer.Option("--resume", metavar="RUN", help="Resume a sweep, or join it (its folder)."),
    ] = None,
    force: options.Force = False,
    out: options.Out = None,
) -> None:
    """Compare matrices, each at its own best gain, leak and number of modes, on the same turbulence."""
    arguments = dict(locals())
    from escape_hw.runtime.sweep.request import require_optuna

    require_optuna()
    if bool(selection.system) == bool(resume):
        raise ConfigError("name a system (see 'escape systems') or a run with --resume, one of the two")
    from escape_hw.runtime.sweep.description import read_description
    from escape_hw.runtime.sweep.design import Design
    from escape_hw.runtime.sweep.workers import open_workers

    given: SweepDescription | _Request
    if resume is not None:
        _refuse_new_options(selection, arguments)
        given = read_description(resume, storage)
        config = context.load_config(selection := replace(selection, system=str(resume / "config.toml")))
        if _show_finished(context, resume, given):
            return
    else:
        config = context.load_config(selection)
        ranges = {"gain": gain, "leak": leak, "dropped_modes": dropped_modes, "delay": delay}
        given = _read_request(
            config, im or (), gains,
            (*(f"{key}={text}" for key, text in ranges.items() if text is not None), *(vary or ())),
            Design(trials, candidates, replicates, final_replicates), frames, calibration_frames,
            dict(sampler=sampler, metric=metric, margin=margin / 100, storage=storage, study=study),
            force,
        )  # fmt: skip
    # The workers are opened first: a scheduler that does not answer is found before the calibrations. A sweep
    # on hardware has none.
    with (
        context.run_folder(config, "sweep", out) as folder,
        closing(open_workers(workers, scheduler)) if config.simulated else nullcontext() as pool,
    ):
        _run(context, selection, given, folder, pool)


def _refuse_new_options(selection: options.SystemSelection, values: Mapping[str, Any]) -> None:
    """Raise if the arguments of :func:`sweep` describe a new sweep beside the one to resume."""
    known = inspect.signature(sweep).parameters
    given = [name for name, value in values.items() if name in known and value != known[name].default]
    given += [name for name in ("set", "seed", "mode") if getattr(selection, name) not in (None, ())]
    if refused := [f"--{name.replace('_', '-')}" for name in given if name not in _RESUMABLE]:
        raise ConfigError(
            f"{', '.join(refused)}: a sweep that is resumed keeps its own; leave it out, or start a new sweep"
        )


def _read_request(
    config: SystemConfig,
    im: Sequence[Path],
    gains: Path | None,
    vary: Sequence[str],
    design: Design,
    frames: int,
    calibration_frames: int | None,
    study: dict[str, Any],
    force: bool,
) -> _Request:
    """Check the options of a new sweep and read its files, before any device is opened."""
    from escape_hw.calibration.docrime.open_loop import require_enough_frames
    from escape_hw.io.fits.gains import load_gains
    from escape_hw.runtime.procedures.matrix_input import load_fitting_matrix
    from escape_hw.runtime.sweep.description import new_description
    from escape_hw.runtime.sweep.design import MatrixVariant
    from escape_hw.runtime.sweep.request import parse_search_space, require_loop_frames

    space = parse_search_space(config, vary)
    require_loop_frames(config, frames)
    if gains is not None and not im:
        raise ConfigError("--gains needs --im: optical gains belong to existing matrices")
    products = [load_fitting_matrix(path, config, force) for path in im]
    variants = [MatrixVariant(one.path.stem, False, one.path, one.sha256) for one in products]
    if not products:
        # Those that are measured: three matrices, on a pyramid also scaled by their optical gains.
        scaled = (False, True) if config.sensor.kind == "pyramid" else (False,)
        names = ("push-pull", "DO-CRIME", "ESCAPE")
        variants = [MatrixVariant(name, gained, Path(), "") for name in names for gained in scaled]
    storage = study["storage"] or "sqlite://"
    new_description(
        config, variants, space, design,
        frames=frames, simulated=config.simulated, **{**study, "storage": storage},
    )  # fmt: skip
    c = config.calibration
    calibration_frames = c.frames if calibration_frames is None else calibration_frames
    if not products:
        require_enough_frames(c, calibration_frames, config.basis.n_modes)
    optical_gains = None if gains is None else load_gains(gains).result
    return _Request(products, optical_gains, space, design, frames, calibration_frames, study, force)


def _run(
    context: CommandContext,
    selection: options.SystemSelection,
    sweep: SweepDescription | _Request,
    folder: RunFolder,
    pool: Workers | None,
) -> None:
    """Run a new sweep or what is left of one, and save its result in the folder."""
    from escape_hw.runtime.session.record import BenchRecord
    from escape_hw.runtime.sweep.matrices import read_variants
    from escape_hw.runtime.sweep.result import sweep_and_analyse

    variants: list[MatrixVariant] = []
    if isinstance(sweep, _Request) and sweep.products:
        variants = read_variants(sweep.products, sweep.gains, folder.path)
    with context.bench(selection) as bench:
        record = BenchRecord.from_bench(bench)
        description = (
            _describe(context, sweep, variants, bench, folder, record)
            if isinstance(sweep, _Request)
            else sweep
        )
        if pool is None:
            result, stop = context.run_keeping_partial(sweep_and_analyse(description, bench))
    if pool is not None:
        result, stop = context.run_keeping_partial(sweep_and_analyse(description, pool))
    with context.protect_saving(stop):
        _save(context, folder, record.with_end(stop), description, result)
    if stop is not None:
        raise stop


def _show_finished(context: CommandContext, run: Path, description: SweepDescription) -> bool:
    """Show the result of a sweep that has nothing left to run; false when something is left."""
    from escape_hw.runtime.sweep.products import find_finished_result

    document = find_finished_result(run, description)
    if document is None:
        return False
    context.notify(
        f"{run} was finished on {document['finished_utc']}, nothing is left to run; its result is in "
        f"{document['folder']}"
    )
    _show(context, document)
    return True


def _describe(
    context: CommandContext,
    request: _Request,
    variants: list[MatrixVariant],
    bench: Bench,
    folder: RunFolder,
    record: BenchRecord,
) -> SweepDescription:
    """Save the description of a new sweep in the folder; its matrices are measured if there are none."""
    from escape_hw.runtime.procedures.matrix_input import require_hardware_matrix
    from escape_hw.runtime.sweep.description import describe_sweep
    from escape_hw.runtime.sweep.matrices import measure_variants, save_variants

    for product in request.products:
        require_hardware_matrix(product, bench, request.force)
    if not variants:
        frames = request.calibration_frames
        gain_frames = frames if bench.config.sensor.kind == "pyramid" else 0
        measured = context.run(measure_variants(bench, frames=frames, gain_frames=gain_frames))
        variants = save_variants(folder, record, measured)
    description = context.run(
        describe_sweep(
            bench, folder.path, variants, request.space, request.design,
            frames=request.frames, **request.study,
        )
    )  # fmt: skip
    description.save(folder.path)
    return description


def _save(
    context: CommandContext,
    folder: RunFolder,
    record: BenchRecord,
    description: SweepDescription,
    result: SweepResult,
) -> None:
    from escape_hw.runtime.sweep.products import save_sweep

    _show(context, save_sweep(folder, record, description, result, context.wall_seconds))
    if result.partial:
        context.notify(f"resume with: {shlex.join(['escape', 'sweep', '--resume', str(folder.path)])}")
    else:
        with description.open_study() as study:
            study.set_result_folder(str(folder.path))


def _show(context: CommandContext, document: Mapping[str, Any]) -> None:
    from escape_hw.cli.formatting import (
        format_criteria,
        format_products,
        format_verdict,
        rich_table,
        status_line,
    )
    from escape_hw.report.sweep import best_table, importance_table

    context.result(document, met=all(entry["met"] for entry in document["criteria"]))
    context.show(status_line(document["simulated"], document["partial"]))
    if document["best"]:
        context.show(rich_table(best_table(document)))
    if document["sweep"]["importance"]:
        context.show(rich_table(importance_table(document)))
    context.show(*(row["text"] for row in document["comparisons"]))
    context.show(*format_criteria(document["criteria"]), *format_verdict(document))
    context.show(*format_products(document["products"]))
