"""Error of the registration against the number of frames: runs the campaign and draws its curves.

    python benchmarks/studies/sky_time/sky_time.py --first 10000 --realisations 10 --frames 20 50 220 1000 \\
        --out docs/studies/sky-time
    python benchmarks/studies/sky_time/sky_time.py --realisations 5 --frames 1000 8000 --estimators unwhitened

Writes ``SYSTEM-sky-time.jsonl`` (appends one line per realisation; realisations already in the file are
skipped) and ``SYSTEM-sky-time.png``. Prints rms errors with, in brackets, their ratio to the bound where it
is known, normalised chi-squared and mean. A realisation of ``razor-shwfs`` takes one to two minutes of a
core, one of a pyramid several. The goal of a pyramid is that of its own sub-apertures, pixels of the pupil
image.
"""

from __future__ import annotations

import argparse

import numpy as np

from escape_benchmarks.realisation_tables import (
    Line,
    array,
    each_realisation,
    realisation_numbers,
    row,
    study_parser,
    to_json,
)
from escape_hw.api.registration import PARAMETERS
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import (
    ESTIMATORS,
    FRAMES,
    RealisationErrors,
    accuracy_goal,
    run_realisation,
    summary,
)
from escape_hw.report.figures.registration import error_curves
from escape_hw.report.tables import TITLES

#: What a line keeps of a realisation.
_KEPT = ("errors", "sigmas", "exact", "hybrid")


def measure_realisation(options: argparse.Namespace, number: int) -> Line:
    """The line of a realisation."""
    found = run_realisation(options.system, number, options.frames, estimators=options.estimators)
    return {"commit": get_git_state(), **{name: to_json(getattr(found, name)) for name in _KEPT}}


def errors_of_line(line: Line) -> RealisationErrors:
    """The inverse of :func:`measure_realisation`."""
    return RealisationErrors(*(array(line[kept]) for kept in _KEPT))


def print_table(realisations: list[RealisationErrors], frames: list[int]) -> None:
    """Print a table."""
    print(f"| frames | | {' | '.join(f'{TITLES[name][0]} [{TITLES[name][1]}]' for name in PARAMETERS)} |")
    print("|---:|---|" + "---|" * len(PARAMETERS))
    for f, count in enumerate(frames):
        bound = np.sqrt(np.mean([p.hybrid[f] ** 2 for p in realisations], axis=0))
        for e, name in enumerate(ESTIMATORS):
            errors, sigmas = (np.stack([getattr(p, k)[e, f] for p in realisations]) for k in _KEPT[:2])
            if np.isfinite(errors).all():
                ratios = bound if np.isfinite(bound).all() else None
                print(f"| {count:,} | {name} | {row(errors, sigmas, ratios)} |")
        if np.isfinite(bound).all():
            print(f"| | bound | {' | '.join(f'{value:.2g}' for value in bound)} |")


def main() -> None:
    """Measure what is missing, and write the curves."""
    parser = study_parser(__doc__, "razor-shwfs", 20)
    parser.add_argument("--frames", type=int, nargs="+", default=list(FRAMES))
    parser.add_argument("--estimators", nargs="+", choices=ESTIMATORS, default=list(ESTIMATORS))
    options = parser.parse_args()
    options.frames.sort()
    target = options.out / f"{options.system}-sky-time.jsonl"
    asked = {"system": options.system, "frames": options.frames, "estimators": options.estimators}
    lines = each_realisation(
        target, asked, realisation_numbers(options), lambda number: measure_realisation(options, number)
    )
    realisations = [errors_of_line(line) for line in lines]
    curves = summary(realisations, options.frames, accuracy_goal(options.system))
    error_curves(curves).savefig(target.with_suffix(".png"), dpi=110, facecolor="white")
    print_table(realisations, options.frames)
    fewest = ", ".join(
        f"{name} {count or 'none'}"
        for name, count in curves["fewest_frames"].items()
        if name in options.estimators
    )
    print(f"\n{len(realisations)} realisations. Fewest frames that meet the goal: {fewest}.")


if __name__ == "__main__":
    main()
