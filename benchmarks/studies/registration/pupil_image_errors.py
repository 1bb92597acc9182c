"""Error of the mean place of a pyramid's pupil images, on which the shift of a registration depends.

    python benchmarks/studies/registration/pupil_image_errors.py --system maps-nir --first 20
    python benchmarks/studies/registration/pupil_image_errors.py --system maps-nir --first 20 \\
        --contaminated 0.28

The images are located on the frames of a DO-CRIME run, as `escape calibrate` does, without the registration:
a realisation takes some seconds. Realisations and ``--contaminated`` are those of registration_errors.py.
Writes ``pupil-images-SYSTEM-NAME.jsonl``: appends one line per realisation; realisations already in the file
are skipped. Prints rms and mean error along x and y in pixels, rms of the stated error, and normalised
chi-squared.
"""

from __future__ import annotations

import numpy as np
from registration_errors import contamination_overrides

from escape_benchmarks.realisation_tables import Line, each_realisation, realisation_numbers, study_parser
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import require_kind
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.config.sensor import PyramidSection
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System


def run_realisation(system: str, number: int, frames: int, overrides: list[str]) -> Line:
    """Locate the images of one realisation, and compare with the truth."""
    _, config = realisation_config(system, number, overrides)
    with System.from_config(config) as bench:
        pupils = require_kind(bench.run(docrime_run(bench, frames=frames)).result.grid, PyramidPupils)
    true = np.add(config.sensor_as(PyramidSection).pupils_px, config.twin.pyramid.centre_offsets_px)
    error = (pupils.centres_px - true).mean(axis=0)
    return {"error_px": error.tolist(), "sigma_px": pupils.centre_sigma_px}


def print_table(rows: list[Line]) -> None:
    """Print the statistics."""
    errors, sigmas = np.array([row["error_px"] for row in rows]), np.array([row["sigma_px"] for row in rows])
    statistics = {
        "rms": np.sqrt(np.mean(np.square(errors), axis=0)),
        "mean": errors.mean(axis=0),
        "stated": [np.sqrt(np.mean(np.square(sigmas)))],
        "chi2": np.mean(np.square(errors / sigmas[:, None]), axis=0),
    }
    print(f"{len(rows)} realisations")
    for name, values in statistics.items():
        print(f"{name:7s}", *(f"{value:8.4f}" for value in values))


def main() -> None:
    """Measure what is missing, and print the table."""
    parser = study_parser(__doc__, "maps-nir", 16)
    parser.add_argument("--frames", type=int, default=1500)
    parser.add_argument("--contaminated", type=float)
    parser.add_argument("--name", default="bundled")
    options = parser.parse_args()
    share = options.contaminated
    overrides = [] if share is None else contamination_overrides(share)
    rows = each_realisation(
        options.out / f"pupil-images-{options.system}-{options.name}.jsonl",
        {"system": options.system, "frames": options.frames, "set": overrides},
        realisation_numbers(options),
        lambda number: run_realisation(options.system, number, options.frames, overrides),
        lambda row: f"{np.round(row['error_px'], 4).tolist()} +- {row['sigma_px']:.4f}",
    )
    print_table(rows)


if __name__ == "__main__":
    main()
