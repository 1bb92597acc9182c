"""Error of the tracker over random realisations, each with a mirror and a registration of its own.

    python benchmarks/studies/loops/tracked_realisations.py --system razor-pywfs --realisations 6 --out DIR

A realisation is calibrated in open loop, on a pyramid scaled by its optical gains, and tracked while shift x
moves. The errors are those of the mean of all seconds after the first ten, and of the last second; the stated
error is that of the last second. Writes ``SYSTEM-tracked.jsonl``: appends one line per realisation;
realisations already in the file are skipped. Prints rms errors with, in brackets, normalised chi-squared and
mean error.
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
from escape_hw.errors import CalibrationError
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System
from escape_sim.devices.true_optical_gains import get_simulated_bench

#: Seconds of tracking that the mean excludes.
SETTLED_S = 10.0
LABELS = {
    "mean": f"tracked, mean after {SETTLED_S:.0f} s",
    "last": "tracked, last second",
}


def measure_realisation(options: argparse.Namespace, number: int) -> Line:
    """Errors of the mean of the tracked seconds and of the last one, and stated errors of the last."""
    drift = f"twin.drift.rate.shift_x={options.drift / options.seconds:.8g}"
    _, config = realisation_config(options.system, number, [drift])
    with System.from_config(config) as bench:
        start = bench.calibrate(frames=options.frames)
        if start.registration is None:
            raise CalibrationError(f"realisation {number}: no registration from the calibration")
        if config.sensor.kind == "pyramid":
            start = bench.find_optical_gains(start, accuracy=0.05, frames=2000).rescaled_calibration
        twin = get_simulated_bench(bench)
        origin = twin.now_s
        found = bench.track(start, seconds=options.seconds, poke=options.poke)
        seconds = found.column("seconds")
        truth = np.array([twin.flexure.at(origin + t).to_array() for t in seconds])
    rows = np.stack([found.column(name) for name in PARAMETERS], axis=1)
    sigmas = np.stack([found.column(f"{name}_sigma") for name in PARAMETERS], axis=1)
    settled = seconds > SETTLED_S
    errors = {
        "mean": (rows - truth)[settled].mean(axis=0),
        "last": rows[-1] - truth[-1],
    }
    return {
        "errors": {name: to_json(error) for name, error in errors.items()},
        "sigmas": {"last": to_json(sigmas[-1])},
        "scatter": to_json((rows - truth)[settled].std(axis=0)),
        "alarms": [alarm.text for alarm in found.alarms],
        "frames": found.frames,
        "commit": get_git_state(),
    }  # fmt: skip


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = study_parser(__doc__, "razor-pywfs", 6)
    parser.add_argument("--seconds", type=float, default=20.0)
    parser.add_argument("--drift", type=float, default=2.0, help="shift x over the run, %% of a sub-aperture")
    parser.add_argument("--poke", type=float, default=5e-4)
    parser.add_argument("--frames", type=int, default=2000, help="frames of the calibration")
    options = parser.parse_args()
    target = options.out / f"{options.system}-tracked.jsonl"
    asked = {name: getattr(options, name) for name in ("system", "seconds", "drift", "poke", "frames")}
    lines = each_realisation(
        target, asked, realisation_numbers(options), lambda number: measure_realisation(options, number)
    )
    for name, label in LABELS.items():
        errors = np.stack([array(line["errors"][name]) for line in lines])
        sigmas = np.stack([array(line["sigmas"]["last"]) for line in lines])
        print(f"| {label} | {row(errors, sigmas)} |")
    scatter = np.sqrt(np.mean([np.square(array(line["scatter"])) for line in lines], axis=0))
    print("| scatter of the tracked seconds |", " | ".join(f"{value:.2g}" for value in scatter), "|")
    print(f"{sum(bool(line['alarms']) for line in lines)} of {len(lines)} with an alarm")


if __name__ == "__main__":
    main()
