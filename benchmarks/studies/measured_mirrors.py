"""Registration and influence functions of a real ALPAO DM97 from its matrices of 25 dates.

    python benchmarks/studies/measured_mirrors.py --data ../shared/data/dm97 --out
    docs/studies/measured-mirrors

Writes ``dm97.jsonl``, one line per date: registration, errors, residual, shape; and for successive dates what
the synthetic matrix of the earlier one, at the registration of the later, leaves of the later measured
matrix, beside what the earlier measured matrix leaves, and the eigenvalues of the loop with the synthetic
matrix. Takes two minutes.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from realisation_tables import append_line, study_parser

from escape_benchmarks.measured.dm97 import fit_matrix, make_model, read_entries, read_matrix
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.calibration.sprint.fit import SprintFit
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_matrix
from escape_hw.calibration.sprint.tip_tilt import TipTiltFreeModel

#: Modes of the loop whose eigenvalues are examined, from the best-seen ones.
_N_MODES = 80


def remaining(measured: NDArray[np.float64], predicted: NDArray[np.float64]) -> float:
    """Rms of the difference relative to the measured matrix, after the best common gain."""
    gain = np.vdot(predicted, measured) / np.vdot(predicted, predicted)
    return float(np.linalg.norm(measured - gain * predicted) / np.linalg.norm(measured))


def loop_eigenvalues(measured: NDArray[np.float64], predicted: NDArray[np.float64]) -> tuple[float, float]:
    """Smallest and largest real part of the eigenvalues of ``R D`` over the best-seen modes."""
    gain = np.vdot(predicted, measured) / np.vdot(predicted, predicted)
    u, s, vt = np.linalg.svd(gain * predicted, full_matrices=False)
    u, s, vt = u[:, :_N_MODES], s[:_N_MODES], vt[:_N_MODES]
    values = np.linalg.eigvals((u.T @ measured @ vt.T) / s[:, None]).real
    return float(values.min()), float(values.max())


def compare(
    later: InteractionMatrix, fit: SprintFit, earlier: InteractionMatrix, old: SprintFit
) -> dict[str, object]:
    """What the matrices of an earlier date predict of a later one with the same mask."""
    if later.valid.shape != earlier.valid.shape or (later.valid != earlier.valid).any():
        return {}
    data = later.data.astype(float)
    moved = fit.estimate.registration.to_array() - old.estimate.registration.to_array()
    at_registration = compute_fitted_matrix(
        TipTiltFreeModel(make_model(later)), fit.estimate.registration, old.estimate, np.eye(later.n_modes)
    )
    return {
        "moved_leaves": remaining(data, at_registration),
        "moved": moved.tolist(), "measured_leaves": remaining(data, earlier.data.astype(float)),
        "synthetic_leaves": remaining(data, old.zonal_matrix()),
        "eigenvalues": loop_eigenvalues(data, at_registration),
    }  # fmt: skip


def describe(line: dict[str, Any]) -> str:
    """One line for the terminal."""
    verdict = "converged" if line["converged"] else line["warnings"][0]
    registration = np.round(line["registration"], 2).tolist()
    text = f"{line['date']}: {verdict}, {registration}, leaves {line['leaves']:.3f}"
    if "moved" in line:
        text += f"; earlier measured matrix {line['measured_leaves']:.3f}"
        text += f", synthetic {line['synthetic_leaves']:.3f}, at this registration {line['moved_leaves']:.3f}"
        text += f", eigenvalues {line['eigenvalues'][0]:.2f} to {line['eigenvalues'][1]:.2f}"
    return text


def main() -> None:
    """Fit all dates, compare successive ones, write and print."""
    parser = study_parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help="folder with dm97.json")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / "dm97.jsonl"
    target.unlink(missing_ok=True)
    before: tuple[InteractionMatrix, SprintFit] | None = None
    for entry in read_entries(options.data):
        matrix = read_matrix(options.data, entry["date"])
        fit = fit_matrix(matrix)
        estimate, corrections = fit.estimate, fit.estimate.actuator_corrections
        line = {
            "date": entry["date"], "moves": entry["alive"], "n_valid": entry["n_valid"],
            "converged": estimate.converged, "warnings": list(estimate.warnings),
            "registration": estimate.registration.to_array().tolist(), "sigma": estimate.sigma.tolist(),
            "chi2": estimate.chi2, "leaves": remaining(matrix.data.astype(float), fit.zonal_matrix()),
            "width": estimate.width.value,
            "shape": [] if corrections is None else corrections.shape.tolist(),
        }  # fmt: skip
        if estimate.converged:
            if before is not None:
                line |= compare(matrix, fit, *before)
            before = matrix, fit
        append_line(target, line)
        print(describe(line), flush=True)


if __name__ == "__main__":
    main()
