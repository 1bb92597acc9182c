"""``escape sweep``."""

from __future__ import annotations

import shlex
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.bench import Bench
    from escape_hw.config.models import SystemConfig
    from escape_hw.errors import Aborted
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord
    from escape_hw.runtime.sweep.kept import KeptSweep
    from escape_hw.runtime.sweep.plan import Arm
    from escape_hw.runtime.sweep.result import SweepResult


@dataclass(frozen=True, slots=True)
class _Request:
    """How a new sweep is asked for."""

    im: tuple[Path, ...]
    gains: Path | None
    vary: tuple[str, ...]
    numbers: dict[str, int]
    frames: int
    calibration_frames: int | None
    sampler: str
    metric: str
    margin: float
    storage: str | None
    study: str
    force: bool


def sweep(
    system: Annotated[
        str | None,
        typer.Argument(help="Name of a system (see 'escape systems') or a TOML file; not with --resume."),
    ] = None,
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
    drop: Annotated[str | None, typer.Option("--drop", metavar="LOW:HIGH", help="Dropped modes.")] = None,
    delay: Annotated[
        str | None, typer.Option("--delay", metavar="LOW:HIGH", help="Further delay of a twin, in frames.")
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
        str, typer.Option("--metric", help="Strehl ratio to judge by: peak, otf or encircled.")
    ] = "peak",
    margin: Annotated[
        float, typer.Option("--margin", help="Difference that does not matter, % Strehl.")
    ] = 1.0,
    candidates: Annotated[
        int, typer.Option("--candidates", min=1, help="Parameters of each matrix that run again.")
    ] = 3,
    heats: Annotated[int, typer.Option("--heats", min=1, help="Stretches of air they run again on.")] = 4,
    finals: Annotated[
        int, typer.Option("--finals", min=6, help="Stretches of air for the best of each matrix.")
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
        typer.Option("--storage", metavar="URL", help="Where trials are kept (default: SQLite in the run)."),
    ] = None,
    study: Annotated[str, typer.Option("--study", help="Name of the study in the storage.")] = "sweep",
    resume: Annotated[
        Path | None,
        typer.Option("--resume", metavar="RUN", help="Go on with a sweep, or join it (its folder)."),
    ] = None,
    force: options.Force = False,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Compare matrices, each at its own best gain, leak and number of modes, on the same air."""
    with session("sweep", json=json, quiet=quiet) as one:
        from escape_hw.runtime.sweep.ask import need_optuna, require_loop_frames, swept_space

        need_optuna()
        loop_ranges = {"gain": gain, "leak": leak, "dropped_modes": drop, "delay": delay}
        asked = tuple(f"{key}={text}" for key, text in loop_ranges.items() if text is not None)
        request = _Request(
            tuple(im or ()), gains, (*asked, *(vary or ())),
            {"trials": trials, "candidates": candidates, "heats": heats, "finals": finals},
            frames, calibration_frames, sampler, metric, margin / 100, storage, study, force,
        )  # fmt: skip
        choice = options.Choice.of(_system(system, resume), set, seed, mode)
        config = one.configured(choice)
        going_on = None
        if resume is None:
            swept_space(config, request.vary)
            require_loop_frames(config, frames)
        else:
            going_on = _resumed(resume, storage)
            if _is_finished(one, resume, going_on):
                return
        with one.run_folder(config, "sweep", out) as folder:
            with one.bench(choice) as bench:
                from escape_hw.runtime.records import BenchRecord

                record = BenchRecord.of(bench)
                kept = going_on or _prepared(one, request, config, bench, folder, record)
                if not bench.simulated:
                    result, stop = _run(one, kept, bench)
            if kept.sweep.simulated:
                result, stop = _run(one, kept, _workers(workers, scheduler))
            with one.saving(stop):
                _finish(one, folder, record, kept, result)
            if stop is not None:
                raise stop


def _system(system: str | None, resume: Path | None) -> str:
    from escape_hw.errors import ConfigError

    if (system is None) == (resume is None):
        raise ConfigError("name a system (see 'escape systems') or a run with --resume, one of the two")
    return str(system if resume is None else resume / "config.toml")


def _resumed(run: Path, storage: str | None) -> KeptSweep:
    from escape_hw.runtime.sweep.kept import read_kept

    return read_kept(run, storage)


def _is_finished(one: Session, run: Path, kept: KeptSweep) -> bool:
    """Whether the sweep has nothing left to run; then its result is shown where it lies."""
    from escape_hw.runtime.sweep.finished import finished_document

    document = finished_document(run, kept)
    if document is None:
        return False
    one.tell(
        f"{run} is finished since {document['finished_utc']}, nothing is left to run; its result is in "
        f"{document['folder']}"
    )
    _show(one, document)
    return True


def _prepared(
    one: Session,
    request: _Request,
    config: SystemConfig,
    bench: Bench,
    folder: RunFolder,
    record: BenchRecord,
) -> KeptSweep:
    """Matrices and model PSF of a new sweep, and its description in the run's folder."""
    import numpy as np

    from escape_hw.runtime.procedures import model_psf
    from escape_hw.runtime.sweep.ask import swept_space
    from escape_hw.runtime.sweep.kept import KeptSweep
    from escape_hw.runtime.sweep.plan import Design
    from escape_hw.runtime.sweep.run import Sweep

    space = swept_space(config, request.vary)
    arms = tuple(_arms(one, request, config, bench, folder, record))
    psf = None
    if all("." not in parameter.key for parameter in space):
        psf = folder.file("model_psf.npy")
        np.save(psf, one.run(model_psf(bench)))
    swept = Sweep(
        config.to_toml(), arms, space, Design(**request.numbers), request.frames, config.system.seed,
        request.metric, None if psf is None else str(psf), bench.simulated,
    )  # fmt: skip
    storage = request.storage or f"sqlite:///{folder.file('study.db')}"
    kept = KeptSweep(swept, storage, request.study, request.sampler, request.margin).checked()
    kept.keep(folder.path)
    return kept


def _arms(
    one: Session,
    request: _Request,
    config: SystemConfig,
    bench: Bench,
    folder: RunFolder,
    record: BenchRecord,
) -> list[Arm]:
    from escape_hw.errors import ConfigError
    from escape_hw.io.gains import load_gains
    from escape_hw.runtime.sweep.arms import keep_arms, make_arms, read_arms
    from escape_hw.runtime.task import fitting_matrix, refuse_simulated

    if request.im:
        products = [fitting_matrix(path, config, request.force) for path in request.im]
        for product in products:
            refuse_simulated(product, bench, request.force)
        known = None if request.gains is None else load_gains(request.gains).result
        return read_arms(products, known, folder.path)
    if request.gains is not None:
        raise ConfigError("--gains goes with --im: the gains belong to matrices that exist")
    frames = request.calibration_frames or config.calibration.frames
    pyramid = config.sensor.kind == "pyramid"
    made = one.run(make_arms(bench, frames=frames, gain_frames=frames if pyramid else 0))
    return keep_arms(folder, record, made)


def _workers(count: int, scheduler: str | None) -> Any:
    from escape_hw.runtime.sweep.workers import DaskWorkers, LocalWorkers

    return LocalWorkers(count) if scheduler is None else DaskWorkers(scheduler)


def _run(one: Session, kept: KeptSweep, runner: Any) -> tuple[SweepResult, Aborted | None]:
    from escape_hw.bench import Bench
    from escape_hw.runtime.sweep.result import conclude
    from escape_hw.runtime.sweep.run import run_sweep

    try:
        found, stop = one.attempt(run_sweep(kept.sweep, kept.store(), runner))
    finally:
        if not isinstance(runner, Bench):
            runner.close()
    return conclude(kept.sweep, found, kept.margin), stop


def _finish(
    one: Session, folder: RunFolder, record: BenchRecord, kept: KeptSweep, result: SweepResult
) -> None:
    from escape_hw.runtime.sweep.keep import keep_sweep

    _show(one, keep_sweep(folder, record, kept, result, one.wall_seconds))
    if result.partial:
        one.tell(f"go on with: {shlex.join(['escape', 'sweep', '--resume', str(folder.path)])}")
    else:
        kept.store().mark_finished(str(folder.path))


def _show(one: Session, document: Mapping[str, Any]) -> None:
    from escape_hw.cli.views import bands, checks_view, products_view, rich_table
    from escape_hw.report.sweep_section import best_table, importance_table

    one.result(document, met=all(entry["met"] for entry in document["criteria"]))
    one.show(bands(document["simulated"], document["partial"]))
    if document["best"]:
        one.show(rich_table(best_table(document)))
    if document["sweep"]["importance"]:
        one.show(rich_table(importance_table(document)))
    one.show(*(row["text"] for row in document["comparisons"]))
    one.show(*checks_view(document["criteria"]), *products_view(document["products"]))
