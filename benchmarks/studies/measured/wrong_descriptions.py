"""What SPRINT says of wrongly described matrices: a real DM97 bench, and a small Shack-Hartmann twin.

    python benchmarks/studies/measured/wrong_descriptions.py --data ../shared/data/dm97 \\
        --out docs/studies/measured-mirrors

Each row is one wrong description or one fault that the description does not mention. Writes
``wrong-descriptions.jsonl``: whether the fit converged, the registration relative to that of the correct
description, in stated errors, and what it says; rows that the file has are skipped. Without ``--data`` the
twin is fitted, with it the bench. Prints the table of the page. Takes some minutes.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_benchmarks.measured import dm97
from escape_benchmarks.realisation_tables import append_line, read_lines, study_parser
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run
from escape_hw.api.registration import PARAMETERS
from escape_hw.api.results import RegistrationEstimate
from escape_hw.calibration.sprint.fit import fit_registration
from escape_hw.calibration.sprint.tip_tilt import is_tip_tilt_removed, remove_tip_tilt
from escape_hw.config.loader import load_system
from escape_hw.config.sensor import PyramidSection
from escape_hw.config.system import SystemConfig
from escape_hw.errors import EscapeError
from escape_hw.io.interchange.arrays import design_geometry
from escape_hw.io.provenance import get_git_state
from escape_hw.runtime.session.array_target import array_target
from escape_hw.runtime.session.system import System
from escape_sim.models.factory import make_fast_model

#: Date of the DM97 matrix.
_DATE = "20230901151403"
#: The small twin: 12 x 12 lenslets, 37 actuators, poked one by one through a mirror like the measured one.
_TWIN = (
    "sensor.n_sub=12", "sensor.beam_radius_m=inf", "devices.wfs.region=[220,156,200,200]",
    'devices.dm.layout="circle-7"', "devices.dm.pitches_across_pupil=5.0", "devices.dm.pitch_m=2.7e-3",
    "devices.screen.screen=0", "basis.kind=zonal", "basis.n_modes=37", "calibration.sprint_modes=37",
    "devices.dm.influence=gaussian", "devices.dm.coupling=0.4",
    "twin.mirror.shape=exponential", "twin.mirror.coupling=0.43", "twin.mirror.gain_scatter=0.05",
)  # fmt: skip


@dataclass(frozen=True, slots=True)
class Case:
    """A matrix, the configuration that describes it, and a layout of as many actuators that is wrong."""

    name: str
    matrix: InteractionMatrix
    overrides: Callable[[Sequence[str]], SystemConfig]
    wrong_layout: str

    def fit(self, matrix: InteractionMatrix, overrides: Sequence[str] = ()) -> RegistrationEstimate:
        """SPRINT with the synthetic model of a description."""
        config = self.overrides(overrides)
        valid = matrix.valid
        missing = config.sensor.n_sub - valid.shape[0]
        if missing:
            before = missing // 2
            matrix = replace(matrix, valid=np.pad(valid, (before, missing - before)))
        model = make_fast_model(config, design_geometry(matrix.valid, array_target(config)))
        return run(fit_registration(matrix, model)).estimate


def dm97_case(folder: Path) -> Case:
    """A matrix of the DM97 bench."""
    matrix = dm97.read_matrix(folder, _DATE)
    return Case("dm97", matrix, dm97.load_design, "rows:7,9,9,9,9,11,9,9,9,9,7")


def twin_case() -> Case:
    """The push-pull matrix of the small twin."""

    def describe(overrides: Sequence[str]) -> SystemConfig:
        return load_system("razor-shwfs", overrides=(*_TWIN, *overrides), seed=3)

    with System.from_config(describe(())) as bench:
        matrix = bench.calibrate("push-pull").matrix
    return Case("twin", matrix, describe, "rows:5,5,5,7,5,5,5")


def renumbered(case: Case, turn: Callable[[NDArray[Any]], NDArray[Any]]) -> InteractionMatrix:
    """The matrix with its actuators numbered on a map that is turned."""
    layout = case.overrides(()).devices.dm.actuator_map()
    assert layout is not None, "the mirrors of this study have a map"
    number = np.full(layout.shape, -1)
    number[layout] = np.arange(int(layout.sum()))
    turned = turn(number)
    return replace(case.matrix, m2c=case.matrix.m2c[turned[turned >= 0]])


def with_slopes(
    case: Case, change: Callable[[NDArray[np.float64], NDArray[np.float64]], Sequence[NDArray[np.float64]]]
) -> InteractionMatrix:
    """The matrix with other x and y slopes ``(n_valid, n_modes)``."""
    changed = np.concatenate(change(*np.split(case.matrix.data.astype(float), 2)))
    return replace(case.matrix, data=changed.astype(np.float32))


def without_actuators(case: Case, count: int) -> InteractionMatrix:
    """The matrix of a mirror, some actuators of which do not move."""
    matrix, rng = case.matrix, np.random.default_rng(1)
    data = matrix.data.copy()
    dead = np.sort(rng.choice(matrix.m2c.shape[0], count, replace=False))
    data[:, dead] = rng.normal(size=(len(data), count)) * matrix.sigma[:, dead]
    return as_measured(case, data)


def as_measured(case: Case, data: NDArray[np.float32]) -> InteractionMatrix:
    """A changed matrix without tip and tilt where the sensor removes them."""
    if is_tip_tilt_removed(case.matrix):
        data = remove_tip_tilt(data.astype(float)).astype(np.float32)
    return replace(case.matrix, data=data)


def half_outside(case: Case) -> InteractionMatrix:
    """The matrix where the left half of the sub-apertures has no light: noise only."""
    columns = np.nonzero(case.matrix.valid)[1]
    dark = np.tile(columns < case.matrix.valid.shape[1] / 2, 2)
    data, sigma = case.matrix.data.copy(), case.matrix.sigma[dark]
    data[dark] = np.random.default_rng(2).normal(size=sigma.shape) * sigma
    return as_measured(case, data)


def descriptions(case: Case) -> dict[str, tuple[InteractionMatrix, Sequence[str], NDArray[np.float64]]]:
    """Matrix, overrides, and the change of the registration that is correct with them, by name."""
    matrix, same, config = case.matrix, np.zeros(5), case.overrides(())
    turn = np.deg2rad(1.0)
    assert not isinstance(config.sensor, PyramidSection), "the sensors of this study have lenslets"
    across, n_sub = config.devices.dm.pitches_across_pupil, config.sensor.n_sub
    # With more lenslets across the same beam each is smaller, and the mirror covers fewer than expected.
    more = [f"sensor.n_sub={n_sub + 2}", f"sensor.pitch_px={config.sensor.pitch_px * n_sub / (n_sub + 2)}"]

    def scaled(factor: float) -> NDArray[np.float64]:
        return np.array([0, 0, 0, 100 * (factor - 1), 100 * (factor - 1)])

    return {
        "correct": (matrix, (), same),
        "mirrored": (renumbered(case, lambda grid: grid[:, ::-1]), (), same),
        "quarter turn": (renumbered(case, np.rot90), (), same),
        "wrong layout": (matrix, (f'devices.dm.layout="{case.wrong_layout}"',), same),
        "pitch 5 % too small": (
            matrix, (f"devices.dm.pitches_across_pupil={across * 1.05}",), scaled(1.05),
        ),
        "two lenslets too many": (matrix, more, scaled(n_sub / (n_sub + 2))),
        "five dead actuators": (without_actuators(case, 5), (), same),
        "mirror of another pitch": (
            matrix, (f"devices.dm.pitches_across_pupil={across * 1.4}",), scaled(1.4),
        ),
        "camera clocked by 1 degree": (
            with_slopes(case, lambda x, y: (
                np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y
            )), (), same,
        ),
        "half of the pupil dark": (half_outside(case), (), same),
        "camera stretched by 5 % along x": (with_slopes(case, lambda x, y: (1.05 * x, y)), (), same),
        "image stretched by 5 % along a diagonal": (
            with_slopes(case, lambda x, y: (x + 0.025 * y, y + 0.025 * x)), (), same,
        ),
    }  # fmt: skip


def main() -> None:
    """Fit every description, write and print."""
    parser = study_parser(__doc__)
    parser.add_argument("--data", type=Path, help="folder with dm97.json")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    target = options.out / "wrong-descriptions.jsonl"
    commit = get_git_state()  # before the table, which may be tracked, changes
    saved = {(row["system"], row["description"]): row for row in read_lines(target)}
    for case in [twin_case()] if options.data is None else [dm97_case(options.data)]:
        truth: NDArray[np.float64] | None = None
        for name, (matrix, overrides, change) in descriptions(case).items():
            row: dict[str, Any] = {"system": case.name, "description": name, "commit": commit}
            if (case.name, name) in saved:
                truth = np.array(saved[case.name, name]["registration"]) if truth is None else truth
                continue
            try:
                estimate = case.fit(matrix, overrides)
            except EscapeError as error:
                row |= {"converged": False, "refused": str(error)}
            else:
                value = estimate.registration.to_array()
                truth = value if truth is None else truth
                row |= {
                    "converged": estimate.converged, "registration": value.tolist(),
                    "sigma": estimate.sigma.tolist(), "error": (value - truth - change).tolist(),
                    "chi2": estimate.chi2, "warnings": list(estimate.warnings), "notes": list(estimate.notes),
                }  # fmt: skip
            append_line(target, row)
            print(describe(row), flush=True)
    print_table(read_lines(target))


def print_table(rows: Sequence[dict[str, Any]]) -> None:
    """Markdown of the saved rows: verdict, the largest error in standard errors, and what is said."""
    print("| system | description | verdict | largest error | says |\n|---|---|---|---:|---|")
    for row in rows:
        verdict, pull, said = "refused", "", row.get("refused", "")
        if "error" in row:
            said = " / ".join((row["warnings"] or row["notes"])[:2])
            if row["converged"]:
                verdict, errors = "converged", np.divide(row["error"], row["sigma"])
                k = int(np.argmax(np.abs(errors)))
                pull = f"{PARAMETERS[k].replace('_', ' ')} {row['error'][k]:+.2f} ({errors[k]:+.1f} σ)"
        print(f"| {row['system']} | {row['description']} | {verdict} | {pull} | {said} |")


def describe(row: dict[str, Any]) -> str:
    """One line for the terminal."""
    said = row.get("refused") or "; ".join(row["warnings"]) or "converged"
    error = ""
    if "error" in row:
        parts = zip(PARAMETERS, row["error"], row["sigma"], strict=True)
        error = ", ".join(f"{name} {value:+.2f} ± {sigma:.2g}" for name, value, sigma in parts)
    return f"{row['system']}, {row['description']}: {said}\n    {error}"


if __name__ == "__main__":
    main()
