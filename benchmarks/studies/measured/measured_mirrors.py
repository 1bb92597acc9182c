"""Registration and influence functions of a real ALPAO DM97 from its matrices of 25 dates.

    python benchmarks/studies/measured/measured_mirrors.py --data ../shared/data/dm97 \\
        --out docs/studies/measured-mirrors

Writes ``dm97.jsonl``, one line per date: registration, its errors and those between runs, residual, shape,
gains of the actuators; and for successive dates the change of the registration, and what the synthetic matrix
of the earlier one, at the registration of the later, leaves of the later measured matrix, beside what the
earlier measured matrix leaves, and the eigenvalues of the loop with either. Draws ``dm97.png``, prints
the tables of the page. Takes three minutes on an idle core. Without ``--data`` the existing table is used.
"""

from __future__ import annotations

from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.matrix_agreement import remaining
from escape_benchmarks.measured.dm97 import fit_matrix, make_model, read_entries, read_matrix
from escape_benchmarks.realisation_tables import append_line, read_lines, study_parser
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.synthetic_model import PROFILE_WIDTHS
from escape_hw.calibration.sprint.fit import SprintFit
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_matrix
from escape_hw.calibration.sprint.tip_tilt import TipTiltFreeModel
from escape_hw.io.provenance import get_git_state
from escape_hw.report.comparison import changed_gains
from escape_hw.report.figures import style

#: Modes of the loop whose eigenvalues are examined, from the best-seen ones.
_N_MODES = 80
#: Minutes between matrices that count as repetitions of one set-up.
_MINUTES_APART = 20
#: Standard deviations, of repetitions, that a change needs to count as a jump.
_JUMP = 5.0
#: Change of an actuator's gain from which on the printed table names it.
_NAMED_CHANGE = 0.05
#: Coupling of the nominal mirror, and the exponential (rounding, length in pitches) of the data's README.
_COUPLING, _ROUNDING, _LENGTH = 0.4, 0.25, 0.90


def loop_eigenvalues(measured: NDArray[np.float64], predicted: NDArray[np.float64]) -> tuple[float, float]:
    """Smallest and largest real part of the eigenvalues of ``R D`` over the best-seen modes."""
    gain = np.vdot(predicted, measured) / np.vdot(predicted, predicted)
    u, s, vt = np.linalg.svd(gain * predicted, full_matrices=False)
    u, s, vt = u[:, :_N_MODES], s[:_N_MODES], vt[:_N_MODES]
    values = np.linalg.eigvals((u.T @ measured @ vt.T) / s[:, None]).real
    return float(values.min()), float(values.max())


def between_runs(fit: SprintFit) -> NDArray[np.float64]:
    """Standard errors of the registration between runs ``(5,)``."""
    sigma = fit.estimate.repeatability_sigma
    if sigma is None:
        raise RuntimeError("a fit without repeatability")
    return sigma


def gains(fit: SprintFit) -> NDArray[np.float64]:
    """Relative gains of the actuators ``(n_act,)``."""
    corrections = fit.estimate.actuator_corrections
    if corrections is None:
        raise RuntimeError("a fit without actuators")
    return corrections.gain


def compare(
    later: InteractionMatrix, fit: SprintFit, earlier: InteractionMatrix, old: SprintFit
) -> dict[str, object]:
    """Change since an earlier date, and what the matrices of that date predict where the mask is the same."""
    change = fit.estimate.registration.to_array() - old.estimate.registration.to_array()
    changed = changed_gains(gains(old), gains(fit))
    row: dict[str, object] = {
        "change": change.tolist(), "change_sigma": np.hypot(between_runs(fit), between_runs(old)).tolist(),
        "changed_actuators": {str(k): value for k, value in changed.items()},
    }  # fmt: skip
    if later.valid.shape != earlier.valid.shape or (later.valid != earlier.valid).any():
        return row
    data, before = later.data.astype(float), earlier.data.astype(float)
    at_registration = compute_fitted_matrix(
        TipTiltFreeModel(make_model(later)), fit.estimate.registration, old.estimate, np.eye(later.n_modes)
    )
    steady = np.setdiff1d(np.arange(data.shape[1]), [*changed])
    return row | {
        "moved_leaves": remaining(data, at_registration), "measured_leaves": remaining(data, before),
        "steady_leaves": remaining(data[:, steady], at_registration[:, steady]),
        "synthetic_leaves": remaining(data, old.zonal_matrix()),
        "eigenvalues": loop_eigenvalues(data, at_registration),
        "steady_eigenvalues": loop_eigenvalues(data[:, steady], at_registration[:, steady]),
        "measured_eigenvalues": loop_eigenvalues(data, before),
    }  # fmt: skip


def describe(line: dict[str, Any]) -> str:
    """One line for the terminal."""
    verdict = "converged" if line["converged"] else line["warnings"][0]
    registration = np.round(line["registration"], 2).tolist()
    text = f"{line['date']}: {verdict}, {registration}, leaves {line['leaves']:.3f}"
    if "moved_leaves" in line:
        text += f"; earlier measured matrix {line['measured_leaves']:.3f}"
        text += f", synthetic {line['synthetic_leaves']:.3f}, at this registration {line['moved_leaves']:.3f}"
        text += f", eigenvalues {line['eigenvalues'][0]:.2f} to {line['eigenvalues'][1]:.2f}"
    return text


def measure(folder: Path, target: Path) -> None:
    """Fit all dates, compare successive ones, write and print."""
    commit = get_git_state()  # before the table, which may be tracked, changes
    target.unlink(missing_ok=True)
    before: tuple[InteractionMatrix, SprintFit, str] | None = None
    for entry in read_entries(folder):
        matrix = read_matrix(folder, entry["date"])
        fit = fit_matrix(matrix)
        estimate = fit.estimate
        corrections = estimate.actuator_corrections
        line = {
            "date": entry["date"], "commit": commit, "moves": entry["alive"], "n_valid": entry["n_valid"],
            "converged": estimate.converged, "warnings": list(estimate.warnings),
            "notes": list(estimate.notes), "registration": estimate.registration.to_array().tolist(),
            "sigma": estimate.sigma.tolist(), "repeatability_sigma": between_runs(fit).tolist(),
            "chi2": estimate.chi2, "leaves": remaining(matrix.data.astype(float), fit.zonal_matrix()),
            "gain": estimate.gain.value, "width": estimate.width.value,
            "shape": [] if corrections is None else corrections.shape.tolist(),
            "actuator_gain": np.round(gains(fit), 4).tolist(),
        }  # fmt: skip
        if estimate.converged:
            if before is not None:
                line |= {"earlier": before[2], **compare(matrix, fit, *before[:2])}
            before = matrix, fit, entry["date"]
        append_line(target, line)
        print(describe(line), flush=True)


def is_repetition(line: dict[str, Any]) -> bool:
    """Whether a line and its earlier one were measured minutes apart."""
    if "earlier" not in line:
        return False
    later, earlier = (datetime.strptime(line[key], "%Y%m%d%H%M%S") for key in ("date", "earlier"))
    return (later - earlier).total_seconds() < 60 * _MINUTES_APART


def pulls(line: dict[str, Any]) -> NDArray[np.float64]:
    """Changes since the earlier date in standard errors between runs ``(5,)``."""
    change, sigma = np.array([line["change"], line["change_sigma"]], np.float64)
    return np.asarray(change / sigma)


def profile(line: dict[str, Any], radius: NDArray[np.float64]) -> NDArray[np.float64]:
    """The fitted influence function of inner actuators over distances in pitches, 1 in the middle."""
    widths, shares = (
        line["width"] * np.array(PROFILE_WIDTHS),
        np.array(line["shape"][: len(PROFILE_WIDTHS) - 1]),
    )
    weight = np.concatenate([[1 - shares.sum()], shares])
    value = weight @ _COUPLING ** np.square(radius / widths[:, None])
    return np.asarray(value / weight.sum())


def draw(lines: list[dict[str, Any]], path: Path) -> None:
    """Profile, changes between repetitions, what is left of the next matrix, and eigenvalues."""
    figure = style.new_figure(9.6, 7.2)
    shape, changes, left, loop = figure.subplots(2, 2).ravel()
    radius, used = np.linspace(0, 4, 200), [line for line in lines if line["converged"]]
    for line in used:
        shape.plot(radius, profile(line, radius), color=style.SERIES[0], lw=0.7, alpha=0.6)
    exponential = np.exp(-(np.hypot(radius, _ROUNDING) - _ROUNDING) / _LENGTH)
    shape.plot(radius, exponential, "--", color=style.INK, lw=1.2, label="rounded exponential")
    shape.plot(radius, _COUPLING**radius**2, ":", color=style.INK, lw=1.2, label="nominal Gaussian")
    shape.set(xlabel="distance [pitches]", ylabel="influence", title=f"fitted profile, {len(used)} matrices")
    repeated = [line for line in lines if is_repetition(line)]
    for k, name in enumerate(PARAMETERS):
        values = [pulls(line)[k] for line in repeated]
        places = np.arange(len(repeated)) + 0.12 * (k - 2)
        color = style.SERIES[k % len(style.SERIES)]
        changes.plot(places, values, "o", ms=3.5, color=color, label=name.replace("_", " "))
    changes.set_yscale("symlog", linthresh=5)
    changes.axhspan(-2, 2, color=style.SERIES[1], alpha=0.2, lw=0)
    changes.set(xlabel="pair of matrices, minutes apart", ylabel="change / σ between runs")
    pairs = [line for line in lines if "moved_leaves" in line]
    at = np.arange(len(pairs))
    for key, label in (
        ("measured_leaves", "earlier measured matrix"),
        ("moved_leaves", "synthetic one at the new registration"),
    ):  # fmt: skip
        left.plot(at, [100 * line[key] for line in pairs], "o-", ms=3.5, lw=0.8, label=label)
    left.axhline(10, color=style.INK, lw=0.8, ls=":")
    left.set(xlabel="pair of matrices", ylabel="left of the later matrix [%]", ylim=(0, 36))
    for key, label, offset in (
        ("eigenvalues", "all actuators", -0.12),
        ("steady_eigenvalues", "without changed ones", 0.12),
    ):
        low, high = np.transpose([line[key] for line in pairs])
        loop.errorbar(
            at + offset,
            (low + high) / 2,
            (high - low) / 2,
            fmt="none",
            lw=1.6,
            ecolor=style.SERIES[offset > 0],
            label=label,
        )
    for limit in (0.85, 1.15):
        loop.axhline(limit, color=style.INK, lw=0.8, ls=":")
    loop.set(xlabel="pair of matrices", ylabel="eigenvalues of R D, 80 modes")
    for axes in (shape, changes, left, loop):
        style.style_axes(axes).legend(fontsize=7, frameon=False)
    path.write_bytes(style.png(figure, dpi=100))


def print_tables(lines: list[dict[str, Any]]) -> None:
    """Markdown of the changes, and chi-squared of repetitions."""
    print(
        "| since | at | shift x [%] | shift y [%] | rotation [deg] | radial [%] | tangential [%] "
        "| actuators |"
    )
    print("|---|---|---:|---:|---:|---:|---:|---|")
    for line in (line for line in lines if "change" in line):
        cells = [
            f"{value:+.{digits}f} ({pull:+.1f})"
            for value, pull, digits in zip(line["change"], pulls(line), (2, 2, 3, 2, 2), strict=True)
        ]
        changed = {k: v for k, v in line["changed_actuators"].items() if abs(v) > _NAMED_CHANGE}
        acts = ", ".join(f"{k} ({100 * v:+.0f} %)" for k, v in changed.items())
        stamps = [
            f"{one[4:6]}-{one[6:8]} {one[8:10]}:{one[10:12]}" for one in (line["earlier"], line["date"])
        ]
        print(f"| {' | '.join([*stamps, *cells, acts])} |")
    repeated = np.array([pulls(line) for line in lines if is_repetition(line)])
    quiet = repeated[np.abs(repeated).max(axis=1) < _JUMP]
    for label, values in ("all", repeated), ("without jumps", quiet):
        chi2 = np.mean(np.square(values), axis=0)
        print(
            f"chi-squared of {len(values)} pairs minutes apart, {label}: {np.round(chi2, 2)}, "
            f"mean {chi2.mean():.2f}"
        )


def main() -> None:
    """Measure if data are given; draw and print."""
    parser = study_parser(__doc__)
    parser.add_argument("--data", type=Path, help="folder with dm97.json")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / "dm97.jsonl"
    if options.data is not None:
        measure(options.data, target)
    lines = read_lines(target)
    draw(lines, options.out / "dm97.png")
    print_tables(lines)


if __name__ == "__main__":
    main()
