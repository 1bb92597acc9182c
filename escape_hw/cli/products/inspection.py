"""``escape show``, ``escape compare``, ``escape report`` and ``escape night-log``."""

from __future__ import annotations

import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.errors import CalibrationError, ProductError

if TYPE_CHECKING:
    from escape_hw.api.interaction_matrix import InteractionMatrix


@command("show")
def show(
    context: CommandContext,
    file: Annotated[Path, typer.Argument(help="A product (FITS) or the folder of a run.")],
) -> None:
    """Summarise a product or a run."""
    if file.is_dir():
        _show_run(context, file)
    else:
        _show_product(context, file)


def _show_product(context: CommandContext, file: Path) -> None:
    from escape_hw.cli.formatting import format_verdict, rich_table, status_line
    from escape_hw.cli.products.summaries import summarise_product
    from escape_hw.io.fits import file as fits_file
    from escape_hw.report.tables import Table

    hdus, sha256 = fits_file.read(file)
    header = fits_file.header_dict(hdus)
    document, lines = summarise_product(header["KIND"], file)
    simulated, partial = bool(header["SIMULATE"]), header["FINISH"] == "aborted"
    cards = tuple((key, str(value)) for key, value in header.items())
    context.show(f"{file}: kind {header['KIND']}", status_line(simulated, partial), *lines)
    context.show(*format_verdict(document))
    context.show(rich_table(Table(("Card", "value"), cards, numeric=False)), f"SHA-256: {sha256}")
    context.set_subject(header["SYSTEM"], simulated, header.get("SEED"))
    context.report(**document, file=file.absolute(), header=header, sha256=sha256)


def _show_run(context: CommandContext, folder: Path) -> None:
    from escape_hw.cli.formatting import (
        format_criteria,
        format_products,
        format_values,
        format_verdict,
        registration_remarks,
        rich_table,
        status_line,
    )
    from escape_hw.io.run_folder import RESULT_FILE
    from escape_hw.report.content import read_run
    from escape_hw.report.tables import registration_table, rounds_table, strehl_table
    from escape_hw.report.verdict import verdict_document

    resume = _resume_command(folder)
    if resume and not (folder / RESULT_FILE).is_file():
        context.show(f"{folder}: a run that is not finished and has no result; resume with: {resume}")
        context.report(folder=folder.absolute(), resume=resume)
        return
    run = read_run(folder)
    document = run.document
    context.show(f"{document['command']} on {document['system']}", status_line(run.simulated, run.partial()))
    if run.estimates():
        context.show(rich_table(registration_table(run.estimates(), run.injected)))
        for estimate in run.estimates().values():
            context.show(*registration_remarks(estimate))
    for gains in run.gains.values():
        context.show(rich_table(rounds_table(gains)))
    if run.loops:
        context.show(rich_table(strehl_table(run.loops)))
    context.show(*format_values(document))
    context.show(*format_criteria(document.get("criteria", [])), *format_verdict(document))
    context.show(*format_products(document["products"]))
    if resume and run.partial():
        context.show(f"this run is not finished; resume with: {resume}")
    context.result({**document, "folder": run.folder, "verdict": verdict_document(document)})


def _resume_command(folder: Path) -> str:
    """The command that resumes an incomplete run; empty if the folder has no state to resume from."""
    from escape_hw.io.fits.run_state import STATE_FILE

    for name, verb in ((STATE_FILE, "calibrate"), ("sweep.json", "sweep")):
        if (folder / name).is_file():
            return shlex.join(("escape", verb, "--resume", str(folder)))
    return ""


@command("compare")
def compare(
    context: CommandContext,
    first: Annotated[Path, typer.Argument(metavar="A", help="Interaction matrix (FITS).")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Interaction matrix (FITS).")],
) -> None:
    """Compare two interaction matrices mode by mode, and their registrations."""
    from escape_hw.cli.formatting import rich_table
    from escape_hw.io.fits.matrix import load_matrix
    from escape_hw.report import comparison

    a, b = load_matrix(first), load_matrix(second)
    result = comparison.compare(a.result, b.result)
    context.show(f"A: {first} ({a.matrix.method})", f"B: {second} ({b.matrix.method})")
    context.show(*comparison.summary_lines(result))
    gains = _optical_gains(context, a.matrix, b.matrix)
    context.show(rich_table(comparison.mode_table(result)))
    if result.registration:
        context.show(rich_table(comparison.registration_table(result)))
    simulated = a.matrix.simulated or b.matrix.simulated
    context.set_subject(a.matrix.system, simulated, None)
    context.report(a=first.absolute(), b=second.absolute(), optical_gain=gains, **result.to_dict())


def _optical_gains(
    context: CommandContext, a: InteractionMatrix, b: InteractionMatrix
) -> dict[str, Any] | None:
    """Gains of B relative to A, by the paper's ratio of deviations and by an unbiased projection."""
    from escape_hw.calibration.optical_gain.matrix_comparison import deviation_ratio, projection

    try:
        found = {"deviation_ratio": deviation_ratio(b, a), "projection": projection(b, a)}
    except CalibrationError as error:
        context.show(f"no optical gains: {error}")
        return None
    for name, (value, sigma) in found.items():
        middle, error_of_one = sorted(value)[len(value) // 2], sorted(sigma)[len(sigma) // 2]
        context.show(
            f"optical gain of B over A, {name.replace('_', ' ')}: median {middle:.4f} ± {error_of_one:.2g}"
        )
    return {name: {"value": value, "sigma": sigma} for name, (value, sigma) in found.items()}


@command("report")
def report(
    context: CommandContext,
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Also draw matrices and images as PNG.")
    ] = None,
) -> None:
    """Build the report of a run again from its products."""
    from escape_hw.io.run_folder import read_result
    from escape_hw.io.storage import refuse_existing
    from escape_hw.report.run_report import write_picture, write_report

    if run.is_file():
        raise ProductError(
            f"{run}: a report is built of the folder of a run; "
            f"'escape show {shlex.quote(str(run))}' summarises a product"
        )
    refuse_existing(picture)
    path = write_report(run)
    old = read_result(run)
    context.show(f"report: {path}")
    context.set_subject(old["system"], old["simulated"], old["seed"])
    files: dict[str, Any] = {"report": path}
    if picture is not None:
        files["picture"] = write_picture(run, picture).absolute()
        context.show(f"picture: {picture}")
    context.report(**files)


@command("night-log")
def night_log(
    context: CommandContext,
    system: Annotated[
        str, typer.Argument(help="Name of the system; by default that of the newest log.")
    ] = "",
    night: Annotated[
        str, typer.Option("--night", help="Date of the evening, YYYY-MM-DD; by default the newest.")
    ] = "",
    runs: Annotated[
        Path | None, typer.Option("--runs", help="Folder of the runs; by default the one of your data.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", help="File to write: .html, or .md with figures beside it.")
    ] = None,
) -> None:
    """Show the log of a night, or write it as Markdown or HTML with figures."""
    from escape_hw.io.run_folder import default_runs_folder
    from escape_hw.io.storage import refuse_existing
    from escape_hw.report.night_log import NightReport

    refuse_existing(out)
    report = NightReport.read(runs or default_runs_folder(), system, night)
    files = () if out is None else report.write(out)
    if out is None:
        context.show(report.title, *(f"{name}: {value}" for name, value in report.summary().items()))
        context.show(*(f"{time} {text}" for time, text in report.lines))
    else:
        context.show(*(f"written: {path}" for path in files))
    context.set_subject(report.system, report.simulated, None)
    context.report(
        night=report.night, files=list(files),
        entries=[entry.model_dump(mode="json", exclude_defaults=True) for entry in report.entries],
    )  # fmt: skip
