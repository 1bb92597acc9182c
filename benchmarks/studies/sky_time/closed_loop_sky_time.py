"""Error of the registration from small pokes in a running loop, over random realisations.

    python benchmarks/studies/sky_time/closed_loop_sky_time.py --realisations 10 --frames 1000 --out closed

Each realisation is calibrated in open loop first (1,200 frames at the usual poke); its pseudo-synthetic
matrix closes the loop, and the registration is estimated again from pokes of the given size in closed loop.
Of the first calibration only the matrix is used. Writes ``closed-sky-time.jsonl``: appends one line per
realisation; realisations already in the file are skipped. Prints rms errors with, in brackets, normalised
chi-squared and mean error. A realisation takes half a minute on one core.
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
from escape_hw.errors import CalibrationError
from escape_hw.paper.sky_time import GOAL, realisation_config
from escape_hw.runtime.session.system import System

#: Frames of the calibration that closes the loop.
START_FRAMES = 1200


def measure_realisation(options: argparse.Namespace, number: int) -> Line:
    """Errors and stated errors of a realisation ``(n_frames, 5)``, that of the closing calibration first."""
    injected, config = realisation_config(options.system, number)
    errors, sigmas = np.full((2, 1 + len(options.frames), 5), np.nan)
    with System.from_config(config) as bench:
        closed_loop = bench.calibrate(frames=START_FRAMES)
        found = [closed_loop]
        for count in options.frames:
            found.append(bench.calibrate(frames=count, poke=options.poke, closed_loop=closed_loop))
    for k, calibration in enumerate(found):
        estimate = calibration.registration
        if estimate is None:
            raise CalibrationError(f"realisation {number}: no registration from calibration {k}")
        errors[k], sigmas[k] = estimate.registration.to_array() - injected.to_array(), estimate.sigma
    return {"errors": to_json(errors), "sigmas": to_json(sigmas)}


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = study_parser(__doc__, "razor-shwfs", 10)
    parser.add_argument("--frames", type=int, nargs="+", default=[1000])
    parser.add_argument("--poke", type=float, default=0.002)
    options = parser.parse_args()
    target = options.out / "closed-sky-time.jsonl"
    asked = {"system": options.system, "frames": options.frames, "poke": options.poke}
    lines = each_realisation(
        target, asked, realisation_numbers(options), lambda number: measure_realisation(options, number)
    )
    errors, sigmas = (np.stack([array(line[name]) for line in lines]) for name in ("errors", "sigmas"))
    for k, label in enumerate([f"{START_FRAMES} open", *options.frames]):
        within = (np.abs(errors[:, k]) <= GOAL).all(axis=1).sum()
        print(f"| {label} | {row(errors[:, k], sigmas[:, k])} | {within} of {len(lines)} within the goal")


if __name__ == "__main__":
    main()
