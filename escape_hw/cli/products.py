"""``escape show``, ``escape compare`` and ``escape report``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.matrix import InteractionMatrix


def show(
    file: Annotated[Path, typer.Argument(help="A product (FITS) or the folder of a run.")],
    json: options.Json = False,
) -> None:
    """Summarise a product or a run."""
    with session("show", json=json) as one:
        if file.is_dir():
            _show_run(one, file)
        else:
            _show_product(one, file)


def _show_product(one: Session, file: Path) -> None:
    from escape_hw.cli.product_views import product_view
    from escape_hw.cli.views import bands, rich_table
    from escape_hw.io import documents, fits_file
    from escape_hw.report.tables import Table

    hdus, sha256 = fits_file.read(file)
    header = fits_file.header_dict(hdus)
    document, lines = product_view(header["KIND"], file)
    simulated, partial = bool(header["SIMULATE"]), header["FINISH"] == "aborted"
    cards = tuple((key, str(value)) for key, value in header.items())
    one.show(f"{file}: kind {header['KIND']}", bands(simulated, partial), *lines)
    one.show(rich_table(Table(("Card", "value"), cards, numeric=False)), f"SHA-256: {sha256}")
    head = documents.head("show", header["SYSTEM"], simulated, header.get("SEED"))
    one.result({**head, **document, "file": file.absolute(), "header": header, "sha256": sha256})


def _show_run(one: Session, folder: Path) -> None:
    from escape_hw.cli.views import bands, checks_view, products_view, rich_table
    from escape_hw.report.content import read_run
    from escape_hw.report.tables import registration_table, rounds_table, strehl_table

    run = read_run(folder)
    document = run.document
    one.show(f"{document['command']} on {document['system']}", bands(run.simulated, run.partial()))
    if run.estimates():
        one.show(rich_table(registration_table(run.estimates(), run.planted)))
    for gains in run.gains.values():
        one.show(rich_table(rounds_table(gains)))
    if run.loops:
        one.show(rich_table(strehl_table(run.loops)))
    one.show(*checks_view(document.get("criteria", [])), *products_view(document["products"]))
    one.result({**document, "folder": run.folder})


def compare(
    first: Annotated[Path, typer.Argument(metavar="A", help="Interaction matrix (FITS).")],
    second: Annotated[Path, typer.Argument(metavar="B", help="Interaction matrix (FITS).")],
    json: options.Json = False,
) -> None:
    """Compare two interaction matrices mode by mode, and their registrations."""
    with session("compare", json=json) as one:
        from escape_hw.cli.views import rich_table
        from escape_hw.io.documents import head
        from escape_hw.io.fits import load_matrix
        from escape_hw.report import comparison

        a, b = load_matrix(first), load_matrix(second)
        result = comparison.compare(a.result, b.result)
        one.show(f"A: {first} ({a.matrix.method})", f"B: {second} ({b.matrix.method})")
        one.show(*comparison.lines(result))
        gains = _optical_gains(one, a.matrix, b.matrix)
        one.show(rich_table(comparison.mode_table(result)))
        if result.registration:
            one.show(rich_table(comparison.registration_table(result)))
        simulated = a.matrix.simulated or b.matrix.simulated
        document: dict[str, Any] = head("compare", a.matrix.system, simulated, None)
        document |= {"a": first.absolute(), "b": second.absolute(), "optical_gain": gains}
        one.result({**document, **result.document()})


def _optical_gains(one: Session, a: InteractionMatrix, b: InteractionMatrix) -> dict[str, Any] | None:
    """Gains of B relative to A, by the paper's ratio of deviations and by the unbiased projection."""
    from escape_hw.calibration.optical_gain import deviation_ratio, projection
    from escape_hw.errors import CalibrationError

    try:
        found = {"deviation_ratio": deviation_ratio(b, a), "projection": projection(b, a)}
    except CalibrationError as error:
        one.show(f"no optical gains: {error}")
        return None
    for name, (value, sigma) in found.items():
        middle, error_of_one = sorted(value)[len(value) // 2], sorted(sigma)[len(sigma) // 2]
        one.show(
            f"optical gain of B over A, {name.replace('_', ' ')}: median {middle:.4f} ± {error_of_one:.2g}"
        )
    return {name: {"value": value, "sigma": sigma} for name, (value, sigma) in found.items()}


def report(
    run: Annotated[Path, typer.Argument(help="Folder of a run.")],
    picture: Annotated[
        Path | None, typer.Option("--picture", metavar="FILE", help="Draw matrices and images as PNG, too.")
    ] = None,
    json: options.Json = False,
) -> None:
    """Build report.html of a run again from its products."""
    with session("report", json=json) as one:
        from escape_hw.io.documents import head
        from escape_hw.io.run_folder import read_result
        from escape_hw.report.build import write_report

        path = write_report(run)
        old = read_result(run)
        one.show(f"report: {path}")
        document = head("report", old["system"], old["simulated"], old["seed"])
        document["report"] = path
        if picture is not None:
            from escape_hw.report.picture import write_picture

            document["picture"] = write_picture(run, picture).absolute()
            one.show(f"picture: {picture}")
        one.result(document)
