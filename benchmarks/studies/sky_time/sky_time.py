"""Error of the registration against the number of frames: runs the campaign and draws its curves.

    python benchmarks/studies/sky_time/sky_time.py --realisations 20 --frames 20 50 220 1000 \\
        --out docs/figures
    python benchmarks/studies/sky_time/sky_time.py --realisations 5 --frames 1000 8000 --estimators unwhitened

Writes ``sky-time.jsonl`` (appends one line per realisation; realisations already in the file are skipped),
``sky-time.json`` and ``sky-time.png``, with the name of the system appended for any but ``razor-shwfs``.
Prints rms errors with, in brackets, their ratio to the bound, normalised
chi-squared and mean. Twenty realisations take about twenty minutes on one core (``escape reproduce sky-time``
uses two); on a pyramid (``--system razor-pywfs``) the goal is that of its own sub-apertures, pixels of the
pupil image.
"""

from __future__ import annotations

import argparse
import json

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
from escape_hw.paper.sky_time import (
    ESTIMATORS,
    FRAMES,
    RealisationErrors,
    accuracy_goal,
    run_realisation,
    summary,
)
from escape_hw.report.figures.registration import error_curves

#: What a line keeps of a realisation.
_KEPT = ("errors", "sigmas", "exact", "hybrid")


def measure_realisation(options: argparse.Namespace, number: int) -> Line:
    """The line of a realisation."""
    found = run_realisation(options.system, number, options.frames, estimators=options.estimators)
    return {name: to_json(getattr(found, name)) for name in _KEPT}


def print_table(realisations: list[RealisationErrors], frames: list[int]) -> None:
    """Print a table."""
    for f, count in enumerate(frames):
        bound = np.sqrt(np.mean([p.hybrid[f] ** 2 for p in realisations], axis=0))
        for e, name in enumerate(ESTIMATORS):
            errors, sigmas = (np.stack([getattr(p, k)[e, f] for p in realisations]) for k in _KEPT[:2])
            if np.isfinite(errors).all():
                print(f"| {count:,} | {name} | {row(errors, sigmas, bound)} |")
        if np.isfinite(bound).all():
            print(f"| | bound | {' | '.join(f'{value:.2g}' for value in bound)} |")


def main() -> None:
    """Measure what is missing, and write the curves."""
    parser = study_parser(__doc__, "razor-shwfs", 20)
    parser.add_argument("--frames", type=int, nargs="+", default=list(FRAMES))
    parser.add_argument("--estimators", nargs="+", choices=ESTIMATORS, default=list(ESTIMATORS))
    options = parser.parse_args()
    options.frames.sort()
    name = "sky-time" if options.system == "razor-shwfs" else f"sky-time-{options.system}"
    target = options.out / f"{name}.jsonl"
    asked = {"system": options.system, "frames": options.frames, "estimators": options.estimators}
    lines = each_realisation(
        target, asked, realisation_numbers(options), lambda number: measure_realisation(options, number)
    )
    realisations = [RealisationErrors(*(array(line[kept]) for kept in _KEPT)) for line in lines]
    curves = summary(realisations, options.frames, accuracy_goal(options.system))
    (options.out / f"{name}.json").write_text(json.dumps(curves, indent=1) + "\n")
    error_curves(curves).savefig(options.out / f"{name}.png", dpi=110, facecolor="white")
    print_table(realisations, options.frames)
    print(f"{len(realisations)} realisations; fewest frames that meet the goal: {curves['fewest_frames']}")


if __name__ == "__main__":
    main()
