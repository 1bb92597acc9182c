"""``escape reproduce``: the paper's tables and figures in simulation, with a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.command import CommandGroup, command
from escape_hw.cli.context import CommandContext
from escape_hw.cli.options import SystemSelection
from escape_hw.paper.frame_counts import FRAMES, PAIRED_LOOP_FRAMES, SEEDS

app = typer.Typer(
    help="The paper's tables and figures in simulation, with a report.",
    no_args_is_help=True,
    cls=CommandGroup,
)
_System = Annotated[SystemSelection, typer.Option("--system", help="System to run on.")]
_SHWFS, _PYWFS, _MAPS, _REVOLT = map(
    SystemSelection, ("razor-shwfs", "razor-pywfs", "maps-nir", "revolt-shwfs")
)
_LoopFrames = Annotated[int, typer.Option("--loop-frames", min=1, help="Frames of each loop.")]
_ShortFrames = Annotated[int, typer.Option("--short", min=1, help="Frames of the SHORT run.")]
_LongFrames = Annotated[int, typer.Option("--long", min=1, help="Frames of the LONG run.")]
_DocrimeFrames = Annotated[int, typer.Option("--frames", min=1, help="Frames of the DO-CRIME run.")]


@app.command("shwfs")
@command("reproduce shwfs", quiet=True)
def shwfs(
    context: CommandContext,
    selection: _System = _SHWFS,
    frames: _DocrimeFrames = FRAMES["shwfs"]["frames"],
    loop_frames: _LoopFrames = FRAMES["shwfs"]["loop_frames"],
    realisations: Annotated[
        int,
        typer.Option("--realisations", min=0, help="Random registrations for the curve of error and frames."),
    ] = 4,
    out: options.Out = None,
) -> None:
    """Calibrate with and without a source, close the loop with every matrix, compare."""
    counts = {"frames": frames, "loop_frames": loop_frames, "realisations": realisations}
    _show_comparison(context, *_run_case(context, "shwfs", counts, selection, out))


@app.command("pywfs")
@command("reproduce pywfs", quiet=True)
def pywfs(
    context: CommandContext,
    selection: _System = _PYWFS,
    frames: Annotated[
        int, typer.Option("--frames", min=1, help="Frames of the open-loop DO-CRIME.")
    ] = FRAMES["pywfs"]["frames"],
    closed_frames: Annotated[
        int, typer.Option("--closed-frames", min=1, help="Frames of each round in closed loop, at most.")
    ] = FRAMES["pywfs"]["closed_frames"],
    loop_frames: _LoopFrames = FRAMES["pywfs"]["loop_frames"],
    out: options.Out = None,
) -> None:
    """Matrices, optical gains and loops with and without them, on the pyramid bench."""
    counts = {"frames": frames, "closed_frames": closed_frames, "loop_frames": loop_frames}
    _show_comparison(context, *_run_case(context, "pywfs", counts, selection, out))


@app.command("maps")
@command("reproduce maps", quiet=True)
def maps(
    context: CommandContext,
    selection: _System = _MAPS,
    frames: _DocrimeFrames = FRAMES["maps"]["frames"],
    loop_frames: _LoopFrames = FRAMES["maps"]["loop_frames"],
    out: options.Out = None,
) -> None:
    """Measured matrix beside its simulation, and loops on the sky, with a contaminated mirror."""
    counts = {"frames": frames, "loop_frames": loop_frames}
    _show_comparison(context, *_run_case(context, "maps", counts, selection, out))


@app.command("revolt")
@command("reproduce revolt", quiet=True, without=("mode",))
def revolt(
    context: CommandContext,
    selection: _System = _REVOLT,
    short: _ShortFrames = FRAMES["revolt"]["short"],
    long: _LongFrames = FRAMES["revolt"]["long"],
    loop_frames: _LoopFrames = PAIRED_LOOP_FRAMES,
    seeds: Annotated[int, typer.Option("--seeds", min=2, help="Twins, from --seed on.")] = SEEDS,
    out: options.Out = None,
) -> None:
    """Registration on the sky, and loops with three matrices on equal turbulence, over several twins."""
    counts = {"short": short, "long": long, "loop_frames": loop_frames, "seeds": seeds}
    selection = replace(selection, mode="sim")
    result, document = _run_case(context, "revolt", counts, selection, out)
    _show_registration(context, result.registrations.calibrations, document)
    _show_paired(context, document["paired"])
    _show_criteria(context, document)


@app.command("table1")
@command("reproduce table1", quiet=True)
def table1(
    context: CommandContext,
    selection: _System = _SHWFS,
    short: _ShortFrames = FRAMES["table1"]["short"],
    long: _LongFrames = FRAMES["table1"]["long"],
    out: options.Out = None,
) -> None:
    """Registration from 20 seconds and from 3 minutes of data (paper, Table 1)."""
    counts = {"short": short, "long": long}
    result, document = _run_case(context, "table1", counts, selection, out)
    _show_registration(context, result.calibrations, document)
    _show_criteria(context, document)


@app.command("all")
@command("reproduce all", quiet=True)
def reproduce_all(
    context: CommandContext,
    out: Annotated[Path, typer.Option("--out", help="Folder with one folder for each part.")],
    only: Annotated[
        list[str] | None,
        typer.Option("--only", help="A part (table1, shwfs, pywfs, maps, revolt); repeatable."),
    ] = None,
    share: Annotated[
        float,
        typer.Option(
            "--share", min=0.001, max=1.0, help="Share of the frames, such as 0.1 for a quick test."
        ),
    ] = 1.0,
    sweeps: Annotated[
        list[Path] | None,
        typer.Option("--sweep", metavar="RUN", help="A finished sweep to include; repeatable."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Do not run the parts again that are finished in --out.")
    ] = False,
    set: options.Set = None,
    seed: options.Seed = None,
) -> None:
    """Every table and figure, and a page with links to their reports."""
    from escape_hw.cli.formatting import format_criteria
    from escape_hw.config.loader import load_system
    from escape_hw.paper.cases import (
        check_share,
        find_sweeps,
        load_finished,
        request_fields,
        select_cases,
    )
    from escape_hw.paper.results import write_index, write_results

    parts: dict[str, Any] = {}
    sweep_folders = find_sweeps(sweeps or [])
    cases, finished = select_cases(only), dict[str, Any]()
    for case in cases if resume else ():
        fields = request_fields(case.scaled_frames(share), set, seed)
        finished[case.kind] = load_finished(out / case.kind, case.kind, fields)
    remaining = [case for case in cases if finished.get(case.kind) is None]
    check_share(
        [(case, load_system(case.system, overrides=set or [], seed=seed)) for case in remaining], share
    )
    try:
        for case in cases:
            context.notify(f"{case.kind}: {case.title}")
            part = finished.get(case.kind)
            if part is None:
                selection = SystemSelection(case.system, tuple(set or ()), seed)
                counts = case.scaled_frames(share)
                _, part = _run_case(context, case.kind, counts, selection, out / case.kind)
            else:
                context.notify(f"{case.kind}: finished {part['finished_utc']}, not run again")
            parts[case.kind] = part
            context.show(*format_criteria(part["criteria"]))
    finally:
        if parts:
            context.show(f"index: {write_index(out, parts)}")
            folders = {kind: Path(part["folder"]) for kind, part in parts.items()}
            context.show(f"results: {write_results(out, {**folders, **sweep_folders})}")
    met = all(check["met"] for part in parts.values() for check in part["criteria"])
    simulated = any(part["simulated"] for part in parts.values())
    context.set_subject(None, simulated, seed)
    context.report(met=met, parts=parts, index=str(out.absolute() / "index.html"))


@app.command("sky-time")
@command("reproduce sky-time", quiet=True, without=("seed", "mode"))
def sky_time(
    context: CommandContext,
    selection: _System = _SHWFS,
    realisations: Annotated[int, typer.Option("--realisations", min=2, help="Random registrations.")] = 20,
    frames: Annotated[
        list[int] | None, typer.Option("--frames", min=1, help="Frames at which to estimate; repeatable.")
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Parallel processes.")] = 2,
) -> None:
    """Error of the registration against frames, by estimator, with the Cramer-Rao bound."""
    from escape_hw.paper import sky_time as campaign

    context.load_config(replace(selection, mode="sim"))
    procedure = campaign.sky_time(
        selection.system, realisations=realisations, frames=sorted(frames or campaign.FRAMES),
        overrides=selection.set, workers=workers,
    )  # fmt: skip
    curves, stop = context.run_keeping_partial(procedure)
    context.show(_curves_table(campaign.table_rows(curves)))
    least = ", ".join(f"{name}: {n or 'none of these'}" for name, n in curves["fewest_frames"].items())
    context.show(f"fewest frames that meet the goal in every parameter: {least}")
    if "note" in curves:
        context.notify(curves["note"])
    met = "note" not in curves and curves["fewest_frames"]["telemetry"] is not None
    context.report(**{"simulated": True, **curves}, met=met)
    if stop is not None:
        raise stop


def _curves_table(rows: Any) -> Any:
    from rich.table import Table

    from escape_hw.api.registration import PARAMETERS, UNITS

    table = Table("estimator", "frames", *(f"{p} [{UNITS[p]}]" for p in PARAMETERS), title="rms error (chi2)")
    for row in rows:
        table.add_row(*row)
    return table


def _run_case(
    context: CommandContext,
    kind: str,
    counts: dict[str, int],
    selection: SystemSelection,
    out: Path | None,
) -> tuple[Any, dict[str, Any]]:
    """Run a case and save its result, also a partial one; the user's overrides follow those of the case."""
    from escape_hw.paper.cases import CASES, request_fields

    case = CASES[kind]
    request = request_fields(counts, selection.set, selection.seed)
    selection = replace(selection, set=(*case.overrides, *selection.set))
    config = context.load_config(selection)
    with context.run_folder(config, f"reproduce-{kind}", out) as folder:
        with context.bench(selection) as bench:
            from escape_hw.runtime.session.record import BenchRecord

            record = replace(BenchRecord.from_bench(bench), request=request)
            result, stop = context.run_keeping_partial(case.procedure(bench, **counts))
        with context.protect_saving(stop):
            document = case.save(folder, record.with_end(stop), result, context.wall_seconds)
        context.result(document, met=all(entry["met"] for entry in document["criteria"]))
        if stop is not None:
            raise stop
    return result, document


def _show_comparison(context: CommandContext, result: Any, document: dict[str, Any]) -> None:
    from escape_hw.cli.formatting import rich_table, status_line
    from escape_hw.report.tables import strehl_table

    context.show(status_line(document["simulated"], False))
    if "ESCAPE" in result.calibrations:
        _show_registration(context, {"": result.calibrations["ESCAPE"]}, document)
    context.show(rich_table(strehl_table(result.loops)))
    context.show(*result.notes)
    _show_criteria(context, document)


def _show_registration(context: CommandContext, columns: dict[str, Any], document: dict[str, Any]) -> None:
    from escape_hw.api.registration import Registration
    from escape_hw.cli.formatting import rich_table
    from escape_hw.report.tables import registration_table

    found = {label: item.registration for label, item in columns.items() if item.registration is not None}
    injected = Registration(**document["injected"]) if document["injected"] else None
    context.show(rich_table(registration_table(found, injected)))


def _show_paired(context: CommandContext, paired: dict[str, Any]) -> None:
    from escape_hw.cli.formatting import rich_table
    from escape_hw.report.paired import differences_table, paired_notes, strehl_by_seed_table

    context.show(rich_table(strehl_by_seed_table(paired), "Strehl ratio [%] on equal turbulence"))
    context.show(rich_table(differences_table(paired)), *paired_notes(paired))


def _show_criteria(context: CommandContext, document: dict[str, Any]) -> None:
    from escape_hw.cli.formatting import format_criteria, format_verdict

    context.show(*format_criteria(document["criteria"]), *format_verdict(document))
    context.show(f"report: {document['products']['report']}")
