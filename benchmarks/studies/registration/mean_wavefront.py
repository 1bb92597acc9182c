"""What the mean wavefront of a run changes in the registration on a pyramid.

    python benchmarks/studies/registration/mean_wavefront.py --system maps-nir --first 20 \\
        --out docs/studies/mean-wavefront

Each realisation, as in ``registration_errors.py``, is measured with DO-CRIME under turbulence, and its matrix
is fitted twice: with the model about a flat wavefront, and about the mean wavefront of the run, which is
found in the mean slopes. Writes ``SYSTEM.jsonl``, a line per realisation. Prints rms errors of the
registration with mean squared errors over squared standard errors, and the mean common gain. A realisation
takes one minute (maps-nir) to three (maps-vis, razor-pywfs) of a core.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from escape_benchmarks.realisation_tables import Line, each_realisation, realisation_numbers, study_parser
from escape_hw.api.procedure import run as run_procedure
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.sensor import require_kind
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.sprint.fit import fit_registration, sprint_options_from_config
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.config.registry import model_factory
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System

#: Labels of the two models.
FLAT, MEAN = "flat", "mean of the run"


def run_realisation(system: str, number: int, frames: int) -> Line:
    """Errors of the registration by model."""
    injected, config = realisation_config(system, number, [])
    with System.from_config(config) as bench:
        run = bench.run(docrime_run(bench, frames=frames))
    matrix = decorrelate_columns(run.result.matrix, run.solution.gram, run.solution.variance)
    pupils = require_kind(run.result.grid, PyramidPupils)
    line: Line = {"commit": get_git_state(), "seed": config.system.seed, "fits": {}}
    for label, geometry in ((FLAT, replace(pupils, mean_low_orders=None)), (MEAN, pupils)):
        estimate = run_procedure(
            fit_registration(
                matrix, model_factory(config.calibration.model)(config, geometry), start=injected,
                coarse_search=False, covariance=run.solution.covariance,
                **sprint_options_from_config(config.calibration),
            )
        ).estimate  # fmt: skip
        line["fits"][label] = {
            "error": (estimate.registration.to_array() - injected.to_array()).tolist(),
            "sigma": estimate.sigma.tolist(), "gain": estimate.gain.value, "converged": estimate.converged,
        }  # fmt: skip
    return line


def print_table(rows: list[Line]) -> None:
    """Markdown table of the errors by model."""
    print("| wavefront | shift x [%] | shift y [%] | rotation [deg] | radial [%] | tangential [%] | gain |")
    print("|---|---:|---:|---:|---:|---:|---:|")
    for label in (FLAT, MEAN):
        fits = [row["fits"][label] for row in rows]
        errors, sigmas = (np.array([fit[key] for fit in fits]) for key in ("error", "sigma"))
        rms, chi2 = np.sqrt(np.square(errors).mean(axis=0)), np.square(errors / sigmas).mean(axis=0)
        cells = " | ".join(f"{one:.2g} ({c:.1f})" for one, c in zip(rms, chi2, strict=True))
        print(f"| {label} | {cells} | {np.mean([fit['gain'] for fit in fits]):.2f} |")


def main() -> None:
    """Fit what is missing, and print the table."""
    parser = study_parser(__doc__, "maps-nir", 6)
    parser.add_argument("--frames", type=int, default=1500)
    options = parser.parse_args()
    rows = each_realisation(
        options.out / f"{options.system}.jsonl",
        {"system": options.system, "frames": options.frames},
        realisation_numbers(options),
        lambda number: run_realisation(options.system, number, options.frames),
    )
    print_table(rows)


if __name__ == "__main__":
    main()
