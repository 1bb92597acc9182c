"""Response of lenslets along and across their slopes, and what it does to the scalings of a registration.

    python benchmarks/studies/registration/lenslet_anisotropy.py --out docs/studies/lenslet-anisotropy

Each realisation, as in ``registration_errors.py``, is measured once with DO-CRIME under turbulence and once
by push-pull without it. SPRINT fits both with the anisotropy as a variant of the model and without it;
DO-CRIME's matrix also without it from the y slopes alone, and from the x slopes alone. Writes
``SYSTEM.jsonl``, a line per realisation. Prints the mean errors of the scalings in % of the diameter with the
standard error of that mean, by how many % influence functions are narrower along a slope and wider across it,
and the smallest and largest change by leaving slopes out. A realisation takes half a minute of a core.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from constants import fit_realisations, with_key
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import Line
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run as run_procedure
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.sprint.fit import fit_registration, sprint_options_from_config
from escape_hw.calibration.sprint.telemetry_fit import decorrelate_columns
from escape_hw.config.registry import model_factory
from escape_hw.config.sensor import ShackHartmannSection
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System

#: Factor of the standard errors of slopes that are left out, and of a prior that leaves no anisotropy.
LEFT_OUT, NO_ANISOTROPY = 30.0, 1e-6
#: Fits of a realisation.
WITH, WITHOUT = "with anisotropy", "without"
CALM_WITH, CALM_WITHOUT = "no turbulence, with anisotropy", "no turbulence, without"
NO_X, NO_Y = "without, no x slopes", "without, no y slopes"


def without_slopes(matrix: InteractionMatrix, axis: int) -> InteractionMatrix:
    """The matrix with standard errors of the x (0) or y (1) slopes so large that they do not count."""
    factor = np.repeat(np.where(np.arange(2) == axis, LEFT_OUT, 1.0), matrix.n_slopes // 2)
    return replace(matrix, sigma=(matrix.sigma * factor[:, None]).astype(matrix.sigma.dtype))


def run_realisation(system: str, number: int, frames: int) -> Line:
    """Errors of the registration by fit, and the anisotropy where it is fitted."""
    injected, config = realisation_config(system, number)
    isotropic = with_key(config, "sensor.anisotropy_sigma", NO_ANISOTROPY)
    with System.from_config(config) as bench:
        run = bench.run(docrime_run(bench, frames=frames))
        calm = bench.calibrate("push-pull")
    matrix = decorrelate_columns(run.result.matrix, run.solution.gram, run.solution.variance)
    grid = run.result.grid
    fits = {
        WITH: (config, matrix, grid), WITHOUT: (isotropic, matrix, grid),
        NO_X: (isotropic, without_slopes(matrix, 0), grid),
        NO_Y: (isotropic, without_slopes(matrix, 1), grid),
        CALM_WITH: (config, calm.matrix, calm.grid), CALM_WITHOUT: (isotropic, calm.matrix, calm.grid),
    }  # fmt: skip
    line: Line = {"commit": get_git_state(), "seed": config.system.seed, "fits": {}}
    for label, (settings, measured, known) in fits.items():
        found = run_procedure(
            fit_registration(
                measured, model_factory(settings.calibration.model)(settings, known), start=injected,
                coarse_search=False, covariance=None if measured is calm.matrix else run.solution.covariance,
                **sprint_options_from_config(settings.calibration),
            )
        )  # fmt: skip
        if found.state is None:
            raise SystemExit("calibration.solver must be 'mixed-effects'")
        prior = settings.sensor_as(ShackHartmannSection).anisotropy_sigma
        line["fits"][label] = {
            "error": (found.estimate.registration.to_array() - injected.to_array()).tolist(),
            "sigma": found.estimate.sigma.tolist(), "converged": found.estimate.converged,
            # Wider by this share along a slope, and narrower by it across.
            "anisotropy": prior * float(found.state.variant[-1]),
        }  # fmt: skip
    return line


def print_table(rows: list[Line]) -> None:
    """Markdown tables: errors of both scalings and anisotropy by fit, and changes by leaving slopes out."""

    def of(label: str, key: str) -> NDArray[np.float64]:
        return np.array([row["fits"][label][key] for row in rows])

    def mean(values: NDArray[np.float64], places: str) -> str:
        return f"{values.mean():{places}} ± {values.std(ddof=1) / np.sqrt(len(rows)):{places.lstrip('+')}}"

    print("| fit | radial [%] | tangential [%] | narrower along, wider across [%] |")
    print("|---|---:|---:|---:|")
    for label in rows[0]["fits"]:
        cells = [mean(errors, "+.3f") for errors in of(label, "error")[:, 3:].T]
        cells.append(mean(-100 * of(label, "anisotropy"), ".2f") if "with " in label else "–")
        print(f"| {label} | {' | '.join(cells)} |")
    print("\n| left out | change of the radial scaling [%] | of the tangential one [%] |")
    print("|---|---:|---:|")
    for label, name in ((NO_X, "x slopes"), (NO_Y, "y slopes")):
        change = (of(label, "error") - of(WITHOUT, "error"))[:, 3:]
        radial, tangential = (f"{one.min():+.3f} to {one.max():+.3f}" for one in change.T)
        print(f"| {name} | {radial} | {tangential} |")


def main() -> None:
    """Fit what is missing, and print the table."""
    print_table(fit_realisations(__doc__, 8, "", run_realisation))


if __name__ == "__main__":
    main()
