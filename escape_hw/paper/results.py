"""The paper's numbers and figures beside ours (``results.md``), and a page with links to all reports."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from escape_hw.api.optical_gains import OpticalGains
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import Estimate
from escape_hw.io.documents import dumps
from escape_hw.io.storage import make_folder, write_atomic
from escape_hw.report import html
from escape_hw.report import sweep as sweeps
from escape_hw.report.content import RunContent, read_run
from escape_hw.report.figures import bench as figures_bench
from escape_hw.report.figures import gains as figures_gains
from escape_hw.report.figures import matrix as figures_matrix
from escape_hw.report.figures import registration as figures_registration
from escape_hw.report.figures import style
from escape_hw.report.tables import TITLES, format_percent, format_with_error

#: The paper's Table 1.
TABLE1 = {
    "SHORT": dict(zip(PARAMETERS, ("-15.3", "-71.3", "-0.75", "2.9", "0.17"), strict=True)),
    "LONG": dict(zip(PARAMETERS, ("-16.6", "-71.7", "-0.77", "2.9", "-0.02"), strict=True)),
}


@dataclass(frozen=True, slots=True)
class PaperNumber:
    """A quantity, its value or words in the paper, and our value; ``None`` without the run that gives it."""

    what: str
    paper: str
    ours: str | None


@dataclass(frozen=True, slots=True)
class PaperRun:
    """Name and command of a run, and the function that reads its numbers (from ``None`` without the run)."""

    kind: str
    command: str
    numbers: Callable[[RunContent | None], Iterator[PaperNumber]]


def _calibration(run: RunContent | None, label: str) -> Any:
    return None if run is None else run.calibrations.get(label)


def _table1_numbers(run: RunContent | None) -> Iterator[PaperNumber]:
    found: dict[str, dict[str, float]] = {}
    for column, stated in TABLE1.items():
        result = _calibration(run, f"ESCAPE {column}")
        measured = None if result is None or result.registration is None else result.registration.parameters()
        for name, value in stated.items():
            title, unit = TITLES[name]
            ours = None
            if measured is not None:
                ours = format_with_error(measured[name])
                found.setdefault(column, {})[name] = measured[name].value
            yield PaperNumber(f"Table 1, {column}: {title} [{unit}]", value.replace("-", "−"), ours)
    largest = None
    if len(found) == 2:
        # Tangential scaling is left out, as in the paper: its value is zero.
        pairs = [(found["SHORT"][p], found["LONG"][p]) for p in PARAMETERS[:4]]
        largest = f"{max(100 * abs(a - b) / abs(b) for a, b in pairs):.1f} %"
    yield PaperNumber("Table 1: largest inconsistency of SHORT and LONG", "8 %", largest)
    for column, stated_time in (("SHORT", "≈ 20 s"), ("LONG", "≈ 3 min")):
        result = _calibration(run, f"ESCAPE {column}")
        ours = None if result is None else f"{result.sky_seconds:.0f} s, {result.frames} frames"
        yield PaperNumber(f"sky time of {column}", stated_time, ours)


def _difference(run: RunContent | None, first: str, second: str) -> str | None:
    """Strehl (peak) of one loop minus another's, with both errors."""
    if run is None or first not in run.loops or second not in run.loops:
        return None
    if unstable := [name for name in (first, second) if not run.loops[name].stable]:
        return f"no stable loop with the matrix of {' and '.join(unstable)}"
    a, b = run.loops[first].strehl, run.loops[second].strehl
    if a is None or b is None:
        return "no Strehl ratio: the loops were too short"
    sigma = float(np.hypot(a.peak.sigma, b.peak.sigma))
    return format_percent(Estimate(a.peak.value - b.peak.value, sigma)).strip().replace("-", "−")


def _shwfs_numbers(run: RunContent | None) -> Iterator[PaperNumber]:
    for matrix, words in (("ESCAPE", "consistent"), ("DO-CRIME", "very slightly worse")):
        found = _difference(run, matrix, "push-pull")
        yield PaperNumber(f"Shack-Hartmann, Strehl of {matrix} minus baseline", words, found)
    yield PaperNumber("Shack-Hartmann, loop speed", "500 Hz", _loop_speed(run))


def _loop_speed(run: RunContent | None) -> str | None:
    return None if run is None or not run.loops else f"{next(iter(run.loops.values())).rate_hz:.0f} Hz"


def _format_gains(gains: OpticalGains | None) -> str | None:
    if gains is None:
        return None
    scatter = float(np.std(gains.trend) / np.mean(gains.trend))
    return f"{np.mean(gains.best):.2f}, over the modes ± {100 * scatter:.0f} %"


def _pywfs_numbers(run: RunContent | None) -> Iterator[PaperNumber]:
    result = None if run is None else next(iter(run.gains.values()), None)
    beside: Mapping[str, OpticalGains] = {} if result is None else result.comparisons
    for label, what, sign in (("push-pull", "the baseline", "<"), ("DO-CRIME", "open-loop DO-CRIME", ">")):
        found = _format_gains(beside.get(label))
        yield PaperNumber(f"pyramid, optical gain of {what}", f"{sign} 1, roughly constant", found)
    poke = None if result is None or not result.rounds else f"{100 * result.rounds[-1].poke:.2g} %"
    yield PaperNumber("pyramid, pokes in closed loop, share of the stroke", "0.1 to 0.2 %", poke)
    for first, second, words in (
        ("ESCAPE", "push-pull", "similar"),
        ("ESCAPE + OG", "push-pull + OG", "similar"),
        ("DO-CRIME + OG", "push-pull + OG", "only very marginally worse"),
        ("ESCAPE + OG", "ESCAPE", "very similar"),
    ):
        found = _difference(run, first, second)
        yield PaperNumber(f"pyramid, Strehl of {first} minus {second}", words, found)
    yield PaperNumber("pyramid, loop speed", "300 Hz", _loop_speed(run))


def _maps_numbers(run: RunContent | None) -> Iterator[PaperNumber]:
    result = _calibration(run, "DO-CRIME")
    modes = None if result is None else str(result.matrix.n_modes)
    yield PaperNumber("MAPS, modes of the matrix", "100", modes)
    yield PaperNumber(
        "MAPS, sky time of the matrix", "a few minutes",
        None if result is None else f"{result.sky_seconds / 60:.1f} min",
    )  # fmt: skip
    escape = _calibration(run, "ESCAPE")
    yield PaperNumber(
        "MAPS, pseudo-synthetic matrix", "not attempted",
        None if escape is None else f"Strehl minus DO-CRIME's {_difference(run, 'ESCAPE', 'DO-CRIME')}",
    )  # fmt: skip


def _revolt_numbers(run: RunContent | None) -> Iterator[PaperNumber]:
    for name in PARAMETERS:
        title, unit = TITLES[name]
        columns = [
            format_with_error(estimate.parameters()[name])
            for estimate in ({} if run is None else run.estimates()).values()
        ]
        if run is not None and run.injected is not None:
            columns.append(f"injected {getattr(run.injected, name):g}".replace("-", "−"))
        what = f"REVOLT, SHORT and LONG: {title} [{unit}]"
        yield PaperNumber(what, "no number", "; ".join(columns) or None)
    paired = {} if run is None else run.document.get("paired", {})
    for matrix in ("push-pull", "DO-CRIME", "ESCAPE"):
        found = _mean_strehl(paired, matrix)
        yield PaperNumber(f"REVOLT, Strehl of {matrix}, mean over seeds", "no number", found)
    texts = {(one["first"], one["second"]): one["text"] for one in paired.get("differences", ())}
    for first, second in (("ESCAPE", "push-pull"), ("DO-CRIME", "push-pull"), ("ESCAPE", "DO-CRIME")):
        text = texts.get((first, second))
        ours = None if text is None else text.replace("-", "−")
        yield PaperNumber(f"REVOLT, Strehl of {first} minus {second}, paired by seed", "no number", ours)
    yield PaperNumber("REVOLT, loop speed", "500 Hz", _loop_speed(run))


def _mean_strehl(paired: Mapping[str, Any], matrix: str) -> str | None:
    """Mean Strehl ratio over the seeds, and for how many of them the loop diverged."""
    seeds = paired.get("seeds")
    if not seeds:
        return None
    diverged = sum(not one["stable"][matrix] for one in seeds)
    note = f", of which {diverged} diverged and count with 0" if diverged else ""
    return f"{100 * paired['mean'][matrix]:.1f} %, {len(seeds)} seeds{note}"


def _sweep_numbers(run: RunContent | None) -> Iterator[PaperNumber]:
    document = {} if run is None else run.document
    sweep = document.get("sweep")
    name = "the sweep" if run is None else str(document["system"])
    trials = (
        None if sweep is None else f"{sweep['loops']['explore']}, {sum(sweep['loops'].values())} loops in all"
    )
    yield PaperNumber(f"{name}: randomised trials", "1,000", trials)
    share = None
    if sweep is not None and "matrix" in sweep["importance"]:
        share_of_matrix, chance = sweep["importance"]["matrix"], sweep["importance"].get("chance", 0.0)
        share = f"{100 * share_of_matrix:.1f} % of the variance; a dummy parameter {100 * chance:.1f} %"
    yield PaperNumber(f"{name}: importance of the choice of matrix", "little or none", share)
    stated = [
        row["text"]
        for row in document.get("comparisons", ())
        if row["first"].startswith("ESCAPE") and row["second"] == "push-pull"
    ]
    yield PaperNumber(f"{name}: at their own best parameters", "equivalent", "; ".join(stated) or None)


PAPER_RUNS = (
    PaperRun("table1", "escape reproduce table1", _table1_numbers),
    PaperRun("shwfs", "escape reproduce shwfs --loop-frames 30000", _shwfs_numbers),
    PaperRun("pywfs", "escape reproduce pywfs", _pywfs_numbers),
    PaperRun("maps", "escape reproduce maps", _maps_numbers),
    PaperRun("revolt", "escape reproduce revolt", _revolt_numbers),
    PaperRun("sweep-shwfs", "escape sweep razor-shwfs --trials 1000", _sweep_numbers),
    PaperRun("sweep-pywfs", "escape sweep razor-pywfs --trials 1000 --frames 250", _sweep_numbers),
)


RESULTS = "results.md"


def write_results(folder: Path, runs: Mapping[str, Path]) -> Path:
    """Write ``results.md`` with one row per number, ``results.json``, and an image per figure.

    Parameters
    ----------
    runs
        Run folders by the kinds of :data:`~escape_hw.paper.results.PAPER_RUNS`. Missing ones are marked,
        with the command that runs them.

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
        lines += ["SIMULATED: ours come from simulations.", ""]
    if commits := sorted({str(run.document["git"]) for run in contents.values() if "git" in run.document}):
        lines += [f"Commit of the software: {', '.join(commits)}.", ""]
    lines += ["| number | paper | ours | command |", "|---|---|---|---|"]
    rows = [(part, number) for part in PAPER_RUNS for number in part.numbers(contents.get(part.kind))]
    lines += [f"| {n.what} | {n.paper} | {n.ours or '(not run)'} | `{part.command}` |" for part, n in rows]
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


def _figures(kind: str, run: RunContent) -> Iterator[tuple[str, str, Figure]]:
    """File name, caption and figure of each of the paper's figures of a run."""
    name = str(run.document["system"])
    for label, estimate in run.estimates().items():
        if estimate.iterations:
            caption = f"{name}: convergence of SPRINT {label}".strip()
            yield f"{kind}-convergence", caption, figures_registration.convergence(estimate, run.injected)
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
        yield f"{kind}-loops", f"{name}: Strehl ratio of every drawn loop", sweeps.strehl_scatter(sweep)
        if sweep["importance"]:
            yield f"{kind}-importance", f"{name}: importance of the parameters", sweeps.importance(sweep)
        rows = run.document["comparisons"]
        if rows:
            caption = f"{name}: paired differences at the best parameters, 95 %"
            yield f"{kind}-differences", caption, sweeps.comparisons(rows, sweep["margin"])


INDEX_PAGE = "index.html"


def write_index(folder: Path, parts: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write ``index.html`` with links to the reports of the runs, and return its path.

    ``parts`` are the documents of the runs by name; links are relative to the folder.

    Raises
    ------
    StorageError
        It cannot be written.
    """
    folder = folder.absolute()
    body = ["<h1>The paper's tables and figures, reproduced</h1>"]
    for name, document in parts.items():
        report = document["products"].get("report")
        link = "" if report is None else html.link(os.path.relpath(report, folder), "report")
        checks = html.criteria_list(document.get("criteria") or [])
        body.append(html.section(str(document.get("title") or name), checks, f"<p>{link}</p>"))
    simulated = any(document.get("simulated") for document in parts.values())
    band = "SIMULATED: every number comes from a simulation" if simulated else "HARDWARE"
    path = folder / INDEX_PAGE
    write_atomic(
        path, html.page("Reproduced", [("simulated" if simulated else "hardware", band)], body).encode()
    )
    return path
