"""Bias of the scalings of a registration by the model's motion of neighbouring spots.

    python benchmarks/studies/registration/neighbouring_spots.py --out docs/studies/neighbouring-spots

Each realisation, as in ``registration_errors.py``, has a mirror of Gaussian influence functions, with which
scalings are known best, and is measured with DO-CRIME under turbulence. SPRINT fits the matrix with the
package's model, in which the spots of neighbouring lenslets move independently, and with one in which they
have the same motion; both also without the x slopes and without the y slopes. Writes ``SYSTEM.jsonl``, a
line per realisation. Prints the mean errors of the scalings in % of the diameter with the standard error of
that mean, and mean squared errors over squared standard errors. A realisation takes half a minute of a
core.
"""

from __future__ import annotations

from dataclasses import replace
from unittest import mock

import numpy as np
from constants import fit_realisations
from numpy.typing import NDArray
from validation import GAUSSIAN

from escape_benchmarks.realisation_tables import Line
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run as run_procedure
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.sprint.fit import fit_registration, sprint_options_from_config
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.config.registry import model_factory
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System
from escape_sim.models import shack_hartmann

#: Factor of the standard errors of slopes that are left out.
LEFT_OUT = 30.0


def same_motion(n_nodes: int) -> dict[tuple[int, int], NDArray[np.intp]]:
    """Nodes of the spot motion, the same for all lenslets around a window."""
    return dict.fromkeys(shack_hartmann.NEIGHBOURS, np.arange(n_nodes))


def without_slopes(matrix: InteractionMatrix, axis: int) -> InteractionMatrix:
    """The matrix with standard errors of the x (0) or y (1) slopes so large that they do not count."""
    factor = np.repeat(np.where(np.arange(2) == axis, LEFT_OUT, 1.0), matrix.n_slopes // 2)
    return replace(matrix, sigma=(matrix.sigma * factor[:, None]).astype(matrix.sigma.dtype))


def run_realisation(system: str, number: int, frames: int) -> Line:
    """Errors of the registration by fit."""
    injected, config = realisation_config(system, number, list(GAUSSIAN))
    with System.from_config(config) as bench:
        run = bench.run(docrime_run(bench, frames=frames))
    matrix = decorrelate_columns(run.result.matrix, run.solution.gram, run.solution.variance)
    line: Line = {"commit": get_git_state(), "seed": config.system.seed, "fits": {}}
    for motion, nodes in (("independent", shack_hartmann.nodes_by_step), ("the same", same_motion)):
        for slopes, measured in (
            ("all", matrix), ("y", without_slopes(matrix, 0)), ("x", without_slopes(matrix, 1)),
        ):  # fmt: skip
            with mock.patch.object(shack_hartmann, "nodes_by_step", nodes):
                model = model_factory(config.calibration.model)(config, run.result.grid)
                found = run_procedure(
                    fit_registration(
                        measured, model, start=injected, coarse_search=False,
                        covariance=run.solution.covariance, **sprint_options_from_config(config.calibration),
                    )
                )  # fmt: skip
            line["fits"][f"{motion} | {slopes}"] = {
                "error": (found.estimate.registration.to_array() - injected.to_array()).tolist(),
                "sigma": found.estimate.sigma.tolist(), "converged": found.estimate.converged,
            }  # fmt: skip
    return line


def print_table(rows: list[Line]) -> None:
    """Markdown table of the errors of both scalings by motion and slopes."""
    print("| motion of neighbouring spots | slopes | radial [%] | tangential [%] | chi-squared |")
    print("|---|---|---:|---:|---:|")
    for label in rows[0]["fits"]:
        errors, sigmas = (
            np.array([row["fits"][label][key] for row in rows])[:, 3:] for key in ("error", "sigma")
        )
        means = (f"{one.mean():+.3f} ± {one.std(ddof=1) / np.sqrt(len(rows)):.3f}" for one in errors.T)
        chi_squared = " ".join(f"{value:.1f}" for value in np.square(errors / sigmas).mean(axis=0))
        print(f"| {label} | {' | '.join(means)} | {chi_squared} |")


def main() -> None:
    """Fit what is missing, and print the table."""
    print_table(fit_realisations(__doc__, 8, "", run_realisation))


if __name__ == "__main__":
    main()
