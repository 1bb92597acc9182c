"""``escape reproduce``: the paper's tables and figures on the twins, with a report."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

app = typer.Typer(help="The paper's tables and figures on the twins, with a report.", no_args_is_help=True)
_SYSTEM = "razor-shwfs"
_SystemOption = Annotated[str, typer.Option("--system", help="System to run on.")]


@app.command("shwfs")
def shwfs(
    system: _SystemOption = _SYSTEM,
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames of the DO-CRIME run.")] = 10_000,
    loop_frames: Annotated[int, typer.Option("--loop-frames", min=1, help="Frames of each loop.")] = 30_000,
    plants: Annotated[
        int, typer.Option("--plants", min=0, help="Random plants for the curve of error against frames.")
    ] = 4,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Calibrate with and without a source, close the loop with every matrix, compare."""
    with session("reproduce shwfs", json=json, quiet=quiet) as one:
        counts = {"frames": frames, "loop_frames": loop_frames, "plants": plants}
        result, document = _case(one, "shwfs", counts, options.Choice.of(system, set, seed, mode), out)
        _show_comparison(one, result, document)


@app.command("pywfs")
def pywfs(
    system: Annotated[str, typer.Option("--system", help="System to run on.")] = "razor-pywfs",
    frames: Annotated[
        int, typer.Option("--frames", min=1, help="Frames of the open-loop DO-CRIME.")
    ] = 100_000,
    closed_frames: Annotated[
        int, typer.Option("--closed-frames", min=1, help="Frames of each round in closed loop, at most.")
    ] = 20_000,
    loop_frames: Annotated[int, typer.Option("--loop-frames", min=1, help="Frames of each loop.")] = 20_000,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Matrices, optical gains and loops with and without them, on the pyramid bench."""
    with session("reproduce pywfs", json=json, quiet=quiet) as one:
        counts = {"frames": frames, "closed_frames": closed_frames, "loop_frames": loop_frames}
        result, document = _case(one, "pywfs", counts, options.Choice.of(system, set, seed, mode), out)
        _show_comparison(one, result, document)


@app.command("maps")
def maps(
    system: Annotated[str, typer.Option("--system", help="System to run on.")] = "maps-nir",
    frames: Annotated[int, typer.Option("--frames", min=1, help="Frames of the DO-CRIME run.")] = 60_000,
    loop_frames: Annotated[int, typer.Option("--loop-frames", min=1, help="Frames of each loop.")] = 10_000,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """A matrix measured on the sky beside its simulation, and the loop on ESCAPE's, with a dirty mirror."""
    with session("reproduce maps", json=json, quiet=quiet) as one:
        counts = {"frames": frames, "loop_frames": loop_frames}
        result, document = _case(one, "maps", counts, options.Choice.of(system, set, seed, mode), out)
        _show_comparison(one, result, document)


@app.command("table1")
def table1(
    system: _SystemOption = _SYSTEM,
    short: Annotated[int, typer.Option("--short", min=1, help="Frames of the SHORT run.")] = 10_000,
    long: Annotated[int, typer.Option("--long", min=1, help="Frames of the LONG run.")] = 100_000,
    out: options.Out = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Registration from 20 seconds and from 3 minutes of data (paper, Table 1)."""
    with session("reproduce table1", json=json, quiet=quiet) as one:
        counts = {"short": short, "long": long}
        result, document = _case(one, "table1", counts, options.Choice.of(system, set, seed, mode), out)
        _show_registration(one, result.calibrations, document)
        _show_end(one, document)


@app.command("all")
def everything(
    out: Annotated[Path, typer.Option("--out", help="Folder; each part gets a folder of its own in it.")],
    only: Annotated[
        list[str] | None, typer.Option("--only", help="A part (table1, shwfs, pywfs, maps); repeatable.")
    ] = None,
    share: Annotated[
        float,
        typer.Option("--share", min=0.001, max=1.0, help="Share of the frames: 0.1 to see that it works."),
    ] = 1.0,
    sweeps: Annotated[
        list[Path] | None,
        typer.Option("--sweep", metavar="RUN", help="A finished sweep to show beside; repeatable."),
    ] = None,
    resume: Annotated[
        bool, typer.Option("--resume", help="Take the parts that are finished in --out as they are.")
    ] = False,
    set: options.Set = None,
    seed: options.Seed = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Every table and figure one after the other, and a page that leads to their reports."""
    with session("reproduce all", json=json, quiet=quiet) as one:
        from escape_hw.cli.views import checks_view
        from escape_hw.config.load import load_system
        from escape_hw.io import documents
        from escape_hw.report.index import write_index
        from escape_hw.report.paper_results import write_results
        from escape_hw.runtime.paper import asked_for, chosen, finished, require_share, sweep_runs

        parts: dict[str, Any] = {}
        swept = sweep_runs(sweeps or [])
        done = {
            case.kind: finished(out / case.kind, case.kind, asked_for(case.shortened(share), set, seed))
            if resume
            else None
            for case in chosen(only)
        }
        left = [case for case in chosen(only) if done[case.kind] is None]
        choices = {case.kind: options.Choice.of(case.system, set, seed, None) for case in left}
        require_share(
            [(case, load_system(case.system, overrides=set or [], seed=seed)) for case in left], share
        )
        try:
            for case in chosen(only):
                one.tell(f"{case.kind}: {case.title}")
                kept = done[case.kind]
                if kept is None:
                    counts = case.shortened(share)
                    _, kept = _case(one, case.kind, counts, choices[case.kind], out / case.kind)
                else:
                    one.tell(f"{case.kind}: finished {kept['finished_utc']}, not run again")
                parts[case.kind] = kept
                one.show(*checks_view(parts[case.kind]["criteria"]))
        finally:
            if parts:
                one.show(f"index: {write_index(out, parts)}")
                folders = {kind: Path(part["folder"]) for kind, part in parts.items()}
                one.show(f"results: {write_results(out, {**folders, **swept})}")
        met = all(check["met"] for part in parts.values() for check in part["criteria"])
        simulated = any(part["simulated"] for part in parts.values())
        head = documents.head("reproduce all", None, simulated, seed)
        one.result({**head, "parts": parts, "index": str(out.absolute() / "index.html")}, met=met)


@app.command("sky-time")
def sky_time(
    system: _SystemOption = _SYSTEM,
    plants: Annotated[int, typer.Option("--plants", min=2, help="Random plants.")] = 20,
    frames: Annotated[
        list[int] | None, typer.Option("--frames", min=1, help="Frames to take the errors at; repeatable.")
    ] = None,
    workers: Annotated[int, typer.Option("--workers", min=1, help="Parallel processes.")] = 2,
    set: options.Set = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Error of the registration against frames, by estimator, with the Cramer-Rao bound."""
    with session("reproduce sky-time", json=json, quiet=quiet) as one:
        from escape_hw.io import documents
        from escape_hw.runtime import sky_time as campaign

        config = one.configured(options.Choice.of(system, set, None, "sim"))
        counts = sorted(frames or campaign.FRAMES)
        procedure = campaign.sky_time(
            system, plants=plants, frames=counts, overrides=set or [], workers=workers
        )
        curves, stop = one.attempt(procedure)
        head = documents.head("reproduce sky-time", config.system.name, True, config.system.seed)
        one.show(_curves_table(campaign.rows(curves)))
        least = ", ".join(f"{name}: {n or 'none of these'}" for name, n in curves["fewest_frames"].items())
        one.show(f"fewest frames that meet the goal in every parameter: {least}")
        if "note" in curves:
            one.tell(curves["note"])
        met = "note" not in curves and curves["fewest_frames"]["telemetry"] is not None
        one.result({**head, **curves}, met=met)
        if stop is not None:
            raise stop


def _curves_table(rows: Any) -> Any:
    from rich.table import Table

    from escape_hw.api.registration import PARAMETERS, UNITS

    table = Table("estimator", "frames", *(f"{p} [{UNITS[p]}]" for p in PARAMETERS), title="rms error (chi2)")
    for row in rows:
        table.add_row(*row)
    return table


def _case(
    one: Session, kind: str, counts: dict[str, int], choice: options.Choice, out: Path | None
) -> tuple[Any, dict[str, Any]]:
    """Open, run, close, keep; what an aborted run has measured is kept before it says so.

    What the user sets goes after what the case plants in the twin.
    """
    from escape_hw.runtime.paper import CASES, asked_for

    case = CASES[kind]
    asked = asked_for(counts, choice.set, choice.seed)
    choice = replace(choice, set=(*case.overrides, *choice.set))
    config = one.configured(choice)
    with one.run_folder(config, f"reproduce-{kind}", out) as folder:
        with one.bench(choice) as bench:
            from escape_hw.runtime.records import BenchRecord

            record = replace(BenchRecord.of(bench), asked=asked)
            result, stop = one.attempt(case.procedure(bench, **counts))
        with one.saving(stop):
            document = case.keep(folder, record, result, one.wall_seconds)
        one.result(document, met=all(entry["met"] for entry in document["criteria"]))
        if stop is not None:
            raise stop
    return result, document


def _show_comparison(one: Session, result: Any, document: dict[str, Any]) -> None:
    from escape_hw.cli.views import bands, rich_table
    from escape_hw.report.tables import strehl_table

    one.show(bands(document["simulated"], False))
    if "ESCAPE" in result.calibrations:
        _show_registration(one, {"": result.calibrations["ESCAPE"]}, document)
    one.show(rich_table(strehl_table(result.loops)))
    one.show(*result.notes)
    _show_end(one, document)


def _show_registration(one: Session, columns: dict[str, Any], document: dict[str, Any]) -> None:
    from escape_hw.api.registration import Registration
    from escape_hw.cli.views import rich_table
    from escape_hw.report.tables import registration_table

    found = {label: item.registration for label, item in columns.items() if item.registration is not None}
    planted = Registration(**document["planted"]) if document["planted"] else None
    one.show(rich_table(registration_table(found, planted)))


def _show_end(one: Session, document: dict[str, Any]) -> None:
    from escape_hw.cli.views import checks_view

    one.show(*checks_view(document["criteria"]), f"report: {document['products']['report']}")
