"""Error of the registration from small pokes in a running loop, over random plants.

    python benchmarks/closed_sky_time.py --plants 10 --frames 1000 --poke 0.002 --out closed

Each plant is calibrated in open loop first (1,200 frames at the usual poke); its pseudo-synthetic matrix
closes the loop, and pokes of the given size beside the integrator find the registration again, from nothing
of the calibration before but its matrix. Writes ``closed-sky-time.jsonl``, a line per plant as soon as it is
done; plants that the file has already are not run again. Prints rms errors with, in brackets, normalised
chi-squared and mean error. A plant takes half a minute on one core.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
from plant_tables import Line, array, each_plant, plain, row

from escape_hw.errors import CalibrationError
from escape_hw.runtime.sky_time import GOAL, plant_overrides, random_plant, twins_of
from escape_hw.runtime.system import System

#: Frames of the calibration that closes the loop.
CLOSING = 1200


def measured(options: argparse.Namespace, number: int) -> Line:
    """Errors and stated errors of a plant ``(n_frames, 5)``, that of the closing calibration first."""
    plant = random_plant(number)
    config = twins_of(options.system, plant_overrides(plant), seed=number + 1)
    errors, sigmas = np.full((2, 1 + len(options.frames), 5), np.nan)
    with System.from_config(config) as bench:
        closing = bench.calibrate(frames=CLOSING)
        found = [closing]
        for count in options.frames:
            found.append(bench.calibrate(frames=count, poke=options.poke, closing=closing))
    for k, calibration in enumerate(found):
        estimate = calibration.registration
        if estimate is None:
            raise CalibrationError(f"plant {number}: no registration from calibration {k}")
        errors[k], sigmas[k] = estimate.registration.to_array() - plant.to_array(), estimate.sigma
    return {"errors": plain(errors), "sigmas": plain(sigmas)}


def main() -> None:
    """Parse, measure what is missing, tell."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--system", default="razor-shwfs")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--plants", type=int, default=10)
    parser.add_argument("--frames", type=int, nargs="+", default=[1000])
    parser.add_argument("--poke", type=float, default=0.002)
    parser.add_argument("--out", type=Path, default=Path("."))
    options = parser.parse_args()
    target = options.out / "closed-sky-time.jsonl"
    numbers = range(options.first, options.first + options.plants)
    asked = {"system": options.system, "frames": options.frames, "poke": options.poke}
    lines = each_plant(target, asked, numbers, lambda number: measured(options, number))
    errors, sigmas = (np.stack([array(line[name]) for line in lines]) for name in ("errors", "sigmas"))
    for k, label in enumerate([f"{CLOSING} open", *options.frames]):
        within = (np.abs(errors[:, k]) <= GOAL).all(axis=1).sum()
        print(f"| {label} | {row(errors[:, k], sigmas[:, k])} | {within} of {len(lines)} within the goal")


if __name__ == "__main__":
    main()
