"""Strehl ratio and registration against the magnitude of the star, with ESCAPE's matrix and DO-CRIME's.

    python benchmarks/studies/loops/star_magnitudes.py --system maps-nir --scan 450 --loop 900 \\
        --table docs/studies/star-magnitudes --out magnitudes

Both matrices come from the same frames. Each seed is a twin with a mirror and turbulence of its own, the
same at all magnitudes, and each matrix is closed at its own best gain on equal turbulence
(``loop_comparison.py``). The two are compared like with like: both scaled by their optical gains, or both as
calibrated where the gains are refused. DO-CRIME's is also closed as calibrated at all magnitudes. A
calibration that is refused counts as a Strehl ratio of zero, its message is kept. The mean of
``--sky-frames`` frames beside the star is subtracted from every frame; with 0, one level for all pixels.
Prints the table and draws ``SYSTEM.png`` beside the raw tables ``SYSTEM-MAGNITUDE.jsonl``. A seed takes two
minutes of an idle core. The other options are those of ``loop_comparison.py``.
"""

from __future__ import annotations

import argparse
import time
from pathlib import Path

import numpy as np
from loop_comparison import (
    DOCRIME,
    ESCAPE,
    GAINS,
    comparison_parser,
    complete_options,
    measure_seed,
)
from matplotlib.axes import Axes
from matplotlib.ticker import MultipleLocator

from escape_benchmarks.realisation_tables import Line, each_realisation
from escape_hw.errors import CalibrationError
from escape_hw.io.provenance import get_git_state
from escape_hw.io.run_folder import RunFolder
from escape_hw.pipeline.statistics import MeanInterval, mean_interval
from escape_hw.report.figures.style import INK, SERIES, legend, new_figure, style_axes
from escape_hw.runtime.procedures.detector import DarkProcedure
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import open_system

NAMES = (ESCAPE, DOCRIME)


def sky_frame(options: argparse.Namespace, number: int) -> list[str]:
    """Override that names the mean frame of the sky of a seed, measured unless it is there."""
    if not options.sky_frames:
        return []
    folder = options.out / f"sky-{number}"
    if not (folder / "dark.fits").exists():
        # The faintest star of a twin: the telescope points beside any.
        overrides = [*options.set, "twin.star.magnitude=30"]
        with (
            open_system(options.system, seed=number, set=overrides) as bench,
            RunFolder(options.system, "dark", folder) as run,
        ):
            procedure = DarkProcedure(frames=options.sky_frames, blocked_by_hand=True)
            procedure.save(run, BenchRecord.from_bench(bench), bench.run(procedure), 0.0)
    return [f'devices.wfs.dark_file="{folder / "dark.fits"}"']


def measure_or_refuse(options: argparse.Namespace, number: int, until: float) -> Line:
    """The line of a seed; without optical gains where these are refused, empty where the calibration is."""
    refused, overrides = "", [*options.set, *sky_frame(options, number)]
    for gains in (True, False):
        try:
            now = argparse.Namespace(**{**vars(options), "gains": gains, "set": overrides})
            return {**measure_seed(now, number, until), "refused": refused}
        except CalibrationError as error:
            refused = str(error)
    strehl = {ESCAPE: 0.0, DOCRIME: 0.0}
    return {"registrations": [], "strehl": strehl, "refused": refused, "commit": get_git_state()}


def has_gains(row: Line) -> bool:
    """Whether the matrices of a seed were scaled by optical gains."""
    return ESCAPE + GAINS in row["strehl"]


def strehl(row: Line, name: str) -> float:
    """Strehl ratio in % of a matrix, scaled by its optical gains if these were found."""
    found: dict[str, float] = row["strehl"]
    return found[name + GAINS] if has_gains(row) else found[name]


def difference(rows: list[Line]) -> MeanInterval | None:
    """Strehl ratio with ESCAPE's matrix minus DO-CRIME's; ``None`` where no seed could be calibrated."""
    if not any(row["registrations"] for row in rows):
        return None
    return mean_interval(np.array([strehl(row, ESCAPE) - strehl(row, DOCRIME) for row in rows]))


def shift_errors(rows: list[Line]) -> tuple[list[float], list[float]]:
    """Errors and standard errors of both shifts in % of a sub-aperture, of the converged registrations."""
    found = [one for row in rows for one in row["registrations"] if one["converged"]]
    return [v for one in found for v in one["error"][:2]], [v for one in found for v in one["sigma"][:2]]


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else np.nan


def print_table(tables: dict[float, list[Line]]) -> None:
    """Print a line per magnitude."""
    columns = (
        "magnitude", "seeds with OG", *NAMES, "difference, points", f"{DOCRIME} without OG", "converged",
        "shift, rms error", "stated",
    )  # fmt: skip
    print(f"| {' | '.join(columns)} |")
    print("|---" * len(columns) + "|")
    for magnitude, rows in tables.items():
        means = [np.mean([strehl(row, name) for row in rows]) for name in NAMES]
        without = np.mean([row["strehl"][DOCRIME] for row in rows])
        errors, sigmas = shift_errors(rows)
        print(
            f"| {magnitude:g} | {sum(map(has_gains, rows))} of {len(rows)} | "
            f"{' | '.join(f'{one:.1f}' for one in means)} | {difference(rows) or 'none calibrated'} | "
            f"{without:.1f} | {len(errors) // 2} of {len(rows)} | {_rms(errors):.2g} | {_rms(sigmas):.2g} |"
        )


def _draw_strehl(axes: Axes, tables: dict[float, list[Line]]) -> None:
    """Means over the seeds with their standard errors; solid with optical gains, dashed without."""
    for number, name in enumerate((ESCAPE, DOCRIME)):
        for suffix, line in ((GAINS, "o-"), ("", "s--")):
            found = {
                magnitude: np.array([row["strehl"][name + suffix] for row in rows])
                for magnitude, rows in tables.items()
                if all(name + suffix in row["strehl"] for row in rows)
            }
            if found:
                means = [values.mean() for values in found.values()]
                errors = [values.std(ddof=1) / np.sqrt(values.size) for values in found.values()]
                label = name + suffix if suffix else f"{name}, as calibrated"
                axes.errorbar(
                    list(found), means, errors, fmt=line, color=SERIES[number], label=label, ms=3.5, lw=1.2,
                    capsize=2, mfc=SERIES[number] if suffix else "white",
                )  # fmt: skip
    axes.set(ylabel="Strehl ratio [%]", ylim=(0, None))
    legend(axes)


def _draw_difference(axes: Axes, tables: dict[float, list[Line]]) -> None:
    """Paired differences with their intervals; filled with optical gains, open as calibrated."""
    for scaled, label in ((True, f"both{GAINS}"), (False, "both as calibrated")):
        found = {
            magnitude: one
            for magnitude, rows in tables.items()
            if all(map(has_gains, rows)) is scaled and (one := difference(rows))
        }
        if found:
            means = [one.mean for one in found.values()]
            halves = [one.high - one.mean for one in found.values()]
            axes.errorbar(
                list(found), means, halves, fmt="o" if scaled else "s", color=SERIES[3], label=label, ms=3.5,
                capsize=2, mfc=SERIES[3] if scaled else "white",
            )  # fmt: skip
    axes.axhline(0, color=INK, lw=0.8)
    axes.set(ylabel="ESCAPE minus DO-CRIME [points]")
    legend(axes)


def _draw_shift(axes: Axes, tables: dict[float, list[Line]]) -> None:
    """Error of the shift, with the standard error of an rms of that many values, and the stated one."""
    found = {magnitude: shift_errors(rows) for magnitude, rows in tables.items()}
    found = {magnitude: pair for magnitude, pair in found.items() if pair[0]}
    rms = np.array([_rms(errors) for errors, _ in found.values()])
    half = rms / np.sqrt([2 * len(errors) for errors, _ in found.values()])
    axes.errorbar(list(found), rms, half, fmt="o-", color=SERIES[0], label="rms error", ms=3.5, capsize=2)
    axes.plot(
        list(found), [_rms(sigmas) for _, sigmas in found.values()], "--", color=SERIES[1], label="stated"
    )
    axes.set(ylabel="shift [% of a sub-aperture]", ylim=(0, None))
    legend(axes, loc="upper left")


def main() -> None:
    """Measure what is missing, print the table, and draw the figure."""
    parser = comparison_parser(__doc__, "maps-nir")
    parser.add_argument("--magnitudes", type=float, nargs="+", default=[float(m) for m in range(5, 13)])
    parser.add_argument("--sky-frames", type=int, default=500)
    parser.set_defaults(baseline=0, seeds=[1, 2, 3])
    options = parser.parse_args()
    tables: dict[float, list[Line]] = {}
    overrides, out = list(options.set), options.out
    folder: Path = options.table or out
    until = time.monotonic() + 60 * options.minutes
    for magnitude in options.magnitudes:
        options.set = [*overrides, f"twin.star.magnitude={magnitude:g}"]
        options.out = out / f"magnitude-{magnitude:g}"
        asked = complete_options(parser, options)
        if options.sky_frames:
            asked["sky_frames"] = options.sky_frames
        target = folder / f"{options.system}-{magnitude:g}.jsonl"
        tables[magnitude] = each_realisation(
            target, asked, options.seeds, lambda number: measure_or_refuse(options, number, until)
        )
    print_table(tables)
    figure = new_figure(11.0, 3.4)
    panels = (_draw_strehl, _draw_difference, _draw_shift)
    for draw, axes in zip(panels, figure.subplots(1, len(panels)), strict=True):
        draw(style_axes(axes), tables)
        axes.set(xlabel="magnitude of the star", xlim=(min(tables) - 0.4, max(tables) + 0.4))
        axes.xaxis.set_major_locator(MultipleLocator(1))
    figure.savefig(folder / f"{options.system}.png", dpi=110, facecolor="white")


if __name__ == "__main__":
    main()
