"""Strehl ratio and registration against the magnitude of the star, with ESCAPE's matrix and DO-CRIME's.

    python benchmarks/studies/loops/star_magnitudes.py --system maps-nir --scan 450 --loop 900 \\
        --table docs/studies/star-magnitudes --out magnitudes

Both matrices come from the same frames. Each seed is a twin with a mirror and turbulence of its own, the
same at all magnitudes, and each matrix is closed at its own best gain on equal turbulence
(``loop_comparison.py``): ESCAPE's scaled by its optical gains, or as calibrated where these are refused. A
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

from escape_benchmarks.realisation_tables import Line, each_realisation
from escape_hw.errors import CalibrationError
from escape_hw.io.run_folder import RunFolder
from escape_hw.pipeline.statistics import mean_interval
from escape_hw.report.figures.style import SERIES, legend, new_figure, style_axes
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
    return {"registrations": [], "strehl": {ESCAPE: 0.0, DOCRIME: 0.0}, "refused": refused}


def strehl(row: Line, name: str) -> float:
    """Strehl ratio in %, with optical gains if they were found."""
    found: dict[str, float] = row["strehl"]
    return found.get(name + GAINS, found.get(name, 0.0)) if name == ESCAPE else found[name]


def shift_errors(rows: list[Line]) -> tuple[list[float], list[float]]:
    """Errors and standard errors of both shifts in % of a sub-aperture, of the converged registrations."""
    found = [one for row in rows for one in row["registrations"] if one["converged"]]
    return [v for one in found for v in one["error"][:2]], [v for one in found for v in one["sigma"][:2]]


def _rms(values: list[float]) -> float:
    return float(np.sqrt(np.mean(np.square(values)))) if values else np.nan


def print_table(tables: dict[float, list[Line]]) -> None:
    """Print a line per magnitude."""
    print(f"| magnitude | {' | '.join(NAMES)} | difference | converged | shift, rms error | stated |")
    print("|---" * (5 + len(NAMES)) + "|")
    for magnitude, rows in tables.items():
        values = [np.array([strehl(row, name) for row in rows]) for name in NAMES]
        errors, sigmas = shift_errors(rows)
        print(
            f"| {magnitude:g} | {' | '.join(f'{one.mean():.1f}' for one in values)} | "
            f"{mean_interval(values[0] - values[-1])} | {len(errors) // 2} of {len(rows)} | "
            f"{_rms(errors):.2g} | {_rms(sigmas):.2g} |"
        )


def _draw_strehl(axes: Axes, tables: dict[float, list[Line]]) -> None:
    for name, colour in zip(NAMES, SERIES, strict=False):
        for magnitude, rows in tables.items():
            values = [strehl(row, name) for row in rows]
            axes.plot([magnitude] * len(values), values, ".", color=colour, ms=4, alpha=0.5)
        means = [np.mean([strehl(row, name) for row in rows]) for rows in tables.values()]
        axes.plot(list(tables), means, "-", color=colour, label=name)
    axes.set(xlabel="magnitude of the star", ylabel="Strehl ratio [%]", ylim=(0, None))
    legend(axes)


def _draw_shift(axes: Axes, tables: dict[float, list[Line]]) -> None:
    found = [shift_errors(rows) for rows in tables.values()]
    for k, (label, line) in enumerate((("rms error", "o-"), ("stated", "--"))):
        axes.plot(list(tables), [_rms(pair[k]) for pair in found], line, color=SERIES[0], label=label)
    axes.set(xlabel="magnitude of the star", ylabel="shift [% of a sub-aperture]", ylim=(0, None))
    legend(axes)


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
    figure = new_figure(8.0, 3.2)
    left, right = figure.subplots(1, 2)
    _draw_strehl(style_axes(left), tables)
    _draw_shift(style_axes(right), tables)
    right.set_xlim(left.get_xlim())
    figure.savefig(folder / f"{options.system}.png", dpi=110, facecolor="white")


if __name__ == "__main__":
    main()
