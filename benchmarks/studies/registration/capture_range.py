"""Capture range of SPRINT: random registrations up to two actuator pitches and ten degrees away.

    python benchmarks/studies/registration/capture_range.py --system razor-shwfs --out docs/studies/capture
    python benchmarks/studies/registration/capture_range.py --system razor-pywfs --out docs/studies/capture

Each realisation is a twin with all its imperfections, measured by push-pull without turbulence, two frames
per sign. SPRINT gets that matrix and a model built on the located images, and starts from zero. A realisation
is recovered if SPRINT reports convergence and every parameter is within the tolerance, flagged if
it does not, and wrong otherwise. Writes ``capture-SYSTEM.jsonl``: appends one line per realisation;
realisations already in the file are skipped. Exits with 1 when a realisation was wrong or fewer than 95 in
100 were recovered. A realisation takes five seconds on an idle core, on a pyramid twenty.
"""

from __future__ import annotations

import sys

import numpy as np

from escape_benchmarks.realisation_tables import Line, each_realisation, realisation_numbers, study_parser
from escape_hw.api.registration import Registration
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.io.provenance import get_git_state
from escape_hw.paper.sky_time import registration_overrides, simulated_config
from escape_hw.runtime.session.system import System

#: Largest shift in actuator pitches, rotation in degrees, scaling in %.
PITCHES, ROTATION, SCALING = 2.0, 10.0, 4.0
#: Tolerance of a recovered registration; its shift in actuator pitches.
TOLERANCE_PITCH, TOLERANCE_REST = 0.05, np.array([0.3, 1.0, 1.0])


def distant_registration(number: int, pitch: float) -> Registration:
    """Registration of realisation ``number``; ``pitch`` is the actuators' in % of a sub-aperture."""
    rng = np.random.default_rng(5000 + number)
    shift = rng.uniform(-1, 1, 2) * PITCHES * pitch
    return Registration.from_array(
        np.concatenate([shift, rng.uniform(-1, 1, 3) * [ROTATION, SCALING, SCALING]])
    )


def run_realisation(system: str, number: int) -> Line:
    """Measure one realisation and estimate its registration."""
    config = simulated_config(system)
    pitch = 100 * config.sensor.n_sub / config.devices.dm.pitches_across_pupil
    injected = distant_registration(number, pitch)
    changes = ["calibration.push_pull_frames=2", *registration_overrides(injected)]
    with System.from_config(simulated_config(system, changes, seed=number + 1)) as bench:
        measured = bench.calibrate("push-pull")
        found = sprint(measured.matrix, bench.model(measured.grid), max_iterations=40)
    error = found.registration.to_array() - injected.to_array()
    limits = np.concatenate([[TOLERANCE_PITCH * pitch] * 2, TOLERANCE_REST])
    right = bool((np.abs(error) <= limits).all())
    outcome = ("recovered" if right else "wrong") if found.converged else "flagged"
    return {
        "commit": get_git_state(), "outcome": outcome, "steps": len(found.iterations),
        "injected": injected.to_array().tolist(), "error": error.tolist(), "warnings": list(found.warnings),
    }  # fmt: skip


def print_table(rows: list[Line]) -> None:
    """Print the counts of the outcomes, and the errors of the recovered registrations."""
    counts = ", ".join(
        f"{sum(row['outcome'] == key for row in rows)} {key}" for key in ("recovered", "flagged", "wrong")
    )
    steps = [row["steps"] for row in rows]
    print(f"{len(rows)} realisations: {counts}; {min(steps)} to {max(steps)} steps")
    errors = np.array([row["error"] for row in rows if row["outcome"] == "recovered"])
    if len(errors):
        for name, values in (
            ("rms", np.sqrt(np.mean(errors**2, axis=0))),
            ("largest", np.abs(errors).max(axis=0)),
        ):
            print(f"{name:8s}", *(f"{value:8.3f}" for value in values))


def main() -> int:
    """Measure what is missing, and print the table."""
    options = study_parser(__doc__, "razor-shwfs", 100).parse_args()
    target = options.out / f"capture-{options.system}.jsonl"
    rows = each_realisation(
        target, {"system": options.system}, realisation_numbers(options),
        lambda number: run_realisation(options.system, number),
        lambda row: f"{row['outcome']} after {row['steps']} steps",
    )  # fmt: skip
    print_table(rows)
    recovered, wrong = (sum(row["outcome"] == key for row in rows) for key in ("recovered", "wrong"))
    return 0 if not wrong and recovered >= 0.95 * len(rows) else 1


if __name__ == "__main__":
    sys.exit(main())
