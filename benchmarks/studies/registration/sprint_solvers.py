"""SPRINT's variants beside the default: error and time on the same matrices, measured on the twin.

    python benchmarks/studies/registration/sprint_solvers.py --realisations 8 --frames 1000

Prints a table: rms error over random realisations with all imperfections on, normalised chi-squared, and time
in units of the default's, every variant on every matrix in the same run.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.realisation_tables import study_parser
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.paper.sky_time import realisation_config
from escape_hw.runtime.session.system import System

#: What is tried, by name; the first is the default that times are given in units of.
VARIANTS: dict[str, dict[str, Any]] = {
    "mixed-effects": {},
    "registration-only": {"solver": "registration-only"},
    "frozen-derivatives": {"solver": "frozen-derivatives"},
    "batches, rate 1": {"solver": "batches"},
    "batches, rate 0.2": {"solver": "batches", "learning_rate": 0.2, "max_iterations": 60},
    "diagonal": {"solver": "diagonal"},
    "mixed-effects, 40 modes by snr": {"modes": 40},
    "mixed-effects, first 40 modes": {"modes": 40, "choice": "first"},
    "mixed-effects, 40 modes D-optimal": {"modes": 40, "choice": "d-optimal"},
    "mixed-effects, 40 modes A-optimal": {"modes": 40, "choice": "a-optimal"},
    "mixed-effects, 10 modes by snr": {"modes": 10},
    "mixed-effects, first 10 modes": {"modes": 10, "choice": "first"},
    "mixed-effects, 10 modes D-optimal": {"modes": 10, "choice": "d-optimal"},
    "mixed-effects, Huber": {"loss": "huber"},
}
#: The same with some sub-apertures that see something else.
BAD_SUBAPERTURE_VARIANTS: dict[str, dict[str, Any]] = {
    "bad sub-apertures: mixed-effects": {},
    "bad sub-apertures: mixed-effects, Huber": {"loss": "huber"},
    "bad sub-apertures: registration-only": {"solver": "registration-only"},
    "bad sub-apertures: registration-only, Huber": {"solver": "registration-only", "loss": "huber"},
}
#: Fraction of sub-apertures whose slopes are replaced by those of another one.
_BAD = 0.03


@dataclass(frozen=True, slots=True, eq=False)
class SolverCase:
    """A measured matrix with its covariance, its model and the injected registration."""

    matrix: InteractionMatrix
    covariance: NDArray[np.float64] | None
    model: SyntheticModel
    injected: NDArray[np.float64]


def measure(system: str, number: int, frames: int) -> SolverCase:
    """DO-CRIME on random realisation ``number``, all imperfections on."""
    injected, config = realisation_config(system, number)
    with System.from_config(config) as bench:
        run = bench.run(docrime_run(bench, frames=frames))
        model = bench.model(run.result.grid)
    return SolverCase(run.result.matrix, run.solution.covariance, model, injected.to_array())


def with_bad_subapertures(case: SolverCase, rng: np.random.Generator) -> SolverCase:
    """The same matrix with the slopes of some sub-apertures replaced by those of others."""
    n = case.matrix.n_slopes // 2
    bad = rng.choice(n, max(1, round(_BAD * n)), replace=False)
    seen = rng.choice(n, bad.size)
    data = case.matrix.data.copy()
    for half in (0, n):
        data[half + bad] = case.matrix.data[half + seen]
    return replace(case, matrix=replace(case.matrix, data=data))


def solve_case(
    case: SolverCase, options: dict[str, Any]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Errors and stated errors ``(5,)`` each, and the computing time in seconds."""
    began = time.perf_counter()
    found = sprint(case.matrix, case.model, covariance=case.covariance, **options)
    seconds = time.perf_counter() - began
    return found.registration.to_array() - case.injected, found.sigma, seconds


def table(system: str, realisations: int, frames: int, only: str = "") -> Iterator[str]:
    """Yield rows of the table: the default and those whose names contain ``only``."""
    cases = [measure(system, number, frames) for number in range(realisations)]
    rng = np.random.default_rng(1)
    bad_cases = [with_bad_subapertures(case, rng) for case in cases]
    # Numba compiles on first use, and variants of the model are built then.
    solve_case(cases[0], {})
    default_seconds = 0.0
    for name, options in {**VARIANTS, **BAD_SUBAPERTURE_VARIANTS}.items():
        if default_seconds and only not in name:
            continue
        solutions = [
            solve_case(case, options) for case in (bad_cases if name in BAD_SUBAPERTURE_VARIANTS else cases)
        ]
        errors, sigmas = (np.array([one[k] for one in solutions]) for k in (0, 1))
        seconds = float(np.median([one[2] for one in solutions]))
        default_seconds = default_seconds or seconds
        rms, chi2 = np.sqrt(np.mean(errors**2, axis=0)), np.mean(np.square(errors / sigmas), axis=0)
        cells = [f"{e:.3f} ({c:.1f})" for e, c in zip(rms, chi2, strict=True)]
        yield f"| {name} | {' | '.join(cells)} | {seconds / default_seconds:.2f} |"


def main() -> None:
    """Parse, measure, print."""
    parser = study_parser(__doc__, "razor-shwfs")
    parser.add_argument("--realisations", type=int, default=8)
    parser.add_argument("--frames", type=int, default=1000)
    parser.add_argument("--only", default="", help="part of the names of the variants to try")
    options = parser.parse_args()
    print("| variant | shift x [%] | shift y [%] | rotation [deg] | radial [%] | tangential [%] | time |")
    print("|---|---|---|---|---|---|---|")
    for row in table(options.system, options.realisations, options.frames, options.only):
        print(row, flush=True)


if __name__ == "__main__":
    main()
