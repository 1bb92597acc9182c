"""The paper's numbers and figures beside ours, as a page of text with pictures."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path

from matplotlib.figure import Figure

from escape_hw.io.documents import dumps
from escape_hw.io.storage import make_folder, write_atomic
from escape_hw.report import figures_bench, figures_gains, figures_matrix, figures_registration, style
from escape_hw.report import figures_sweep as sweeps
from escape_hw.report.content import RunContent, read_run
from escape_hw.report.paper_numbers import PARTS, PaperNumber

RESULTS = "results.md"


def write_results(folder: Path, runs: Mapping[str, Path]) -> Path:
    """Write ``results.md`` with one row per number, ``results.json``, and a picture per figure.

    Parameters
    ----------
    folder
        Where to.
    runs
        Run folders by the kinds of :data:`~escape_hw.report.paper_numbers.PARTS`. What is missing says so,
        with the command that makes it.

    Returns
    -------
    Path
        The page.

    Raises
    ------
    ProductError
        A run or one of its products is damaged.
    StorageError
        Something cannot be written.
    """
    make_folder(folder)
    contents = {kind: read_run(path) for kind, path in runs.items()}
    simulated = any(run.simulated for run in contents.values())
    lines = ["# The paper's numbers and ours", ""]
    if simulated:
        lines += ["SIMULATED: ours come from digital twins.", ""]
    lines += ["| number | paper | ours | command |", "|---|---|---|---|"]
    rows = [(part, number) for part in PARTS for number in part.numbers(contents.get(part.kind))]
    lines += [_row(number, part.command) for part, number in rows]
    for kind, run in contents.items():
        for name, caption, figure in _figures(kind, run):
            write_atomic(folder / f"{name}.png", style.png(figure, dpi=80))
            lines += ["", f"![{caption}]({name}.png)", "", f"*{caption}*"]
    path = folder / RESULTS
    write_atomic(path, ("\n".join(lines) + "\n").encode())
    document = [
        {"number": n.what, "paper": n.paper, "ours": n.ours, "command": part.command} for part, n in rows
    ]
    write_atomic(folder / "results.json", (dumps({"simulated": simulated, "rows": document}) + "\n").encode())
    return path


def _row(number: PaperNumber, command: str) -> str:
    return f"| {number.what} | {number.paper} | {number.ours or '(not run)'} | `{command}` |"


def _figures(kind: str, run: RunContent) -> Iterator[tuple[str, str, Figure]]:
    """File name, caption and figure of whatever the paper shows of a run."""
    name = str(run.document["system"])
    for label, estimate in run.estimates().items():
        if estimate.iterations:
            caption = f"{name}: convergence of SPRINT {label}".strip()
            yield f"{kind}-convergence", caption, figures_registration.convergence(estimate, run.planted)
            break
    matrices = run.matrices()
    if matrices and kind != "table1" and not kind.startswith("sweep"):
        yield f"{kind}-matrices", f"{name}: interaction matrices", figures_matrix.mode_maps(matrices)
    for result in run.gains.values():
        if result.rounds:
            yield f"{kind}-gains", f"{name}: optical gains", figures_gains.optical_gains(result)
    if any(loop.psf is not None for loop in run.loops.values()):
        yield f"{kind}-psf", f"{name}: stacked images", figures_bench.stacked_psfs(run.loops, run.psf_px)
    sweep = run.document.get("sweep")
    if sweep and sweep["loops"]["explore"]:
        yield f"{kind}-loops", f"{name}: Strehl ratio of every drawn loop", sweeps.strehl_against(sweep)
        if sweep["importance"]:
            yield f"{kind}-importance", f"{name}: importance of the parameters", sweeps.importance(sweep)
        rows = run.document["comparisons"]
        if rows:
            caption = f"{name}: paired differences at the best parameters, 95 %"
            yield f"{kind}-differences", caption, sweeps.comparisons(rows, sweep["margin"])
