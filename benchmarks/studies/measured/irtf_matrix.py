"""Measured influence functions of IRTF's adaptive secondary against its measured matrices.

    python benchmarks/studies/measured/irtf_matrix.py --data ../shared/data/irtf \\
        --out docs/studies/irtf-matrix

The synthetic matrix is the mean slope of the measured surfaces over each of 12 x 12 sub-apertures. SPRINT
fits its registration to the matrices of two days, in all eight orientations of the camera, and then gains and
positions of single actuators in the best one. Of the 2 x 2 sensor the scatter of nine DO-CRIME matrices
of a night is compared with their mean. Writes ``irtf.json`` and ``irtf.png``. Takes half a minute.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from escape_benchmarks.matrix_agreement import correlation, remaining
from escape_benchmarks.realisation_tables import study_parser
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run
from escape_hw.api.registration import Registration
from escape_hw.array_files import read_array
from escape_hw.calibration.sprint.fit import fit_registration
from escape_hw.io.documents import dumps
from escape_hw.report.figures import style
from escape_sim.mirror.measured import MeasuredInfluenceFunctions

N_SUB = 12
#: Residual relative to the least one below which orientations count as equally good.
_EQUAL = 1.02
_SURFACES = "irtf-1_infl_func_20250404b.fits"
_MATRICES = ("imat.12x12.20250909a.npy", "imat.12x12.20250910a.npy")
#: Orientations of the surfaces on the camera: transposed, then mirrored along x and y.
_ORIENTATIONS = tuple((t, x, y) for t in (False, True) for x in (False, True) for y in (False, True))
#: Nodes per sub-aperture along an axis, and weights of Simpson's rule along an edge.
_NODES, _EDGE = 2, np.array([1, 4, 1]) / 6
#: Pixels by which the surfaces are continued beyond their grid.
_RIM = 8


class MeasuredModel:
    """Mean slopes of measured surfaces over the sub-apertures, in units of a sub-aperture.

    Parameters
    ----------
    surfaces
        Surfaces per unit command ``(n_act, n, n)``, as wide as the pupil.
    valid
        Valid sub-apertures ``(n_sub, n_sub)``.
    """

    name = "measured surfaces"
    sub_aperture_m = 1.0

    def __init__(self, surfaces: NDArray[np.float64], valid: NDArray[np.bool_]) -> None:
        self._surfaces, self._valid = surfaces, valid
        # The outer sub-apertures end half a pixel beyond the grid, and move; outside of it surfaces are zero.
        wider = np.pad(surfaces, ((0, 0), (_RIM, _RIM), (_RIM, _RIM)), mode="edge")
        self._mirror = MeasuredInfluenceFunctions(wider, N_SUB / surfaces.shape[1])
        self.n_act = len(surfaces)
        self._nodes = np.arange(_NODES * N_SUB + 1) / _NODES - N_SUB / 2

    def influence_functions(self) -> tuple[NDArray[np.float64], NDArray[np.bool_], float]:
        """The surfaces; all of their square counts as the pupil."""
        n = self._surfaces.shape[1]
        return self._surfaces, np.ones((n, n), bool), N_SUB / n

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        """Slopes ``(n_slopes, n_act)``; measured surfaces have no other width."""
        surface = self._mirror.surfaces(registration, 1.0, self._nodes, self._nodes)
        along_x = surface[:, :, _NODES::_NODES] - surface[:, :, :-1:_NODES]
        along_y = surface[:, _NODES::_NODES] - surface[:, :-1:_NODES]
        first = range(0, _NODES * N_SUB, _NODES)
        x = np.stack([np.tensordot(along_x[:, k : k + 3], _EDGE, axes=(1, 0)) for k in first], axis=1)
        y = np.stack([np.tensordot(along_y[:, :, k : k + 3], _EDGE, axes=(2, 0)) for k in first], axis=2)
        return np.concatenate([x[:, self._valid], y[:, self._valid]], axis=1).T

    def variants(self) -> Sequence[MeasuredModel]:
        """None."""
        return ()


def read_surfaces(folder: Path) -> NDArray[np.float64]:
    """The measured surfaces ``(36, n, n)``; pixels without a value get that of the nearest one with it."""
    cube = np.moveaxis(np.asarray(read_array(folder / _SURFACES), float), -1, 0)
    missing = np.isnan(cube).any(axis=0)
    nearest = ndimage.distance_transform_edt(missing, return_distances=False, return_indices=True)
    return np.asarray(cube[:, nearest[0], nearest[1]])


def turned(surfaces: NDArray[np.float64], orientation: tuple[bool, bool, bool]) -> NDArray[np.float64]:
    """The surfaces in another orientation."""
    transpose, flip_x, flip_y = orientation
    surfaces = surfaces.swapaxes(1, 2) if transpose else surfaces
    surfaces = surfaces[:, :, ::-1] if flip_x else surfaces
    return surfaces[:, ::-1] if flip_y else surfaces


def read_matrix(folder: Path, file: str) -> InteractionMatrix:
    """A matrix with its mask; the earlier one also has the four sub-apertures behind the secondary."""
    data = np.asarray(read_array(folder / file), np.float32)
    valid = np.asarray(read_array(folder / "validSubAps_12x12.npy")[:N_SUB], bool)
    if len(data) > 2 * valid.sum():
        valid = valid.copy()
        valid[5:7, 5:7] = True
    return InteractionMatrix(
        data, np.zeros_like(data), np.eye(data.shape[1]), valid, "irtf", "push-pull", False,
        slope_unit="unknown",
    )  # fmt: skip


def fit(folder: Path) -> tuple[dict[str, Any], NDArray[np.float64], NDArray[np.float64]]:
    """Registrations of both days; the last measured matrix and its synthetic one."""
    surfaces, document = read_surfaces(folder), {}
    for file in _MATRICES:
        matrix = read_matrix(folder, file)
        by_orientation = {}
        for orientation in _ORIENTATIONS:
            model = MeasuredModel(turned(surfaces, orientation), matrix.valid)
            found = run(fit_registration(matrix, model, solver="registration-only"))
            by_orientation[orientation] = (remaining(matrix.data, found.zonal_matrix()), found, model)
        # A quarter turn is also a registration: of equal residuals, the smallest rotation.
        least = min(one[0] for one in by_orientation.values())
        equal = [key for key, one in by_orientation.items() if one[0] < _EQUAL * least]
        best = min(equal, key=lambda one: abs(by_orientation[one][1].estimate.registration.rotation))
        left, simple, model = by_orientation[best]
        sign = 1 if simple.estimate.gain.value > 0 else -1
        matrix = replace(matrix, data=sign * matrix.data)
        start = simple.estimate.registration
        simple = run(fit_registration(
            matrix, model, start=start, coarse_search=False, solver="registration-only"
        ))  # fmt: skip
        full = run(fit_registration(matrix, model, start=start, coarse_search=False))
        corrections = full.estimate.actuator_corrections
        document[file] = {
            "n_valid": int(matrix.valid.sum()),
            "orientation": dict(zip(("transpose", "flip_x", "flip_y"), best, strict=True)),
            "sign": sign,
            "leaves_by_orientation": [round(one[0], 4) for one in by_orientation.values()],
            "registration_only": summary(simple) | {"leaves": left},
            "mixed_effects": summary(full) | {"leaves": remaining(matrix.data, full.zonal_matrix())},
            "actuator_gain": [] if corrections is None else np.round(1 + corrections.gain, 3).tolist(),
        }  # fmt: skip
        last = matrix.data.astype(float), full.zonal_matrix()
    return document, *last


def summary(found: Any) -> dict[str, Any]:
    """Registration, errors and verdict."""
    estimate = found.estimate
    between = estimate.repeatability_sigma
    return {
        "registration": estimate.registration.to_array().tolist(), "sigma": estimate.sigma.tolist(),
        "repeatability_sigma": None if between is None else between.tolist(),
        "converged": estimate.converged, "warnings": list(estimate.warnings), "notes": list(estimate.notes),
    }  # fmt: skip


def felix(folder: Path) -> tuple[dict[str, Any], NDArray[np.float64], dict[str, NDArray[np.float64]]]:
    """Scatter of the DO-CRIME matrices of a night, and agreement with those of other methods."""
    night = np.stack([read_array(one) for one in sorted(folder.glob("docrime*.npy"))]).astype(float)
    others = {one.stem: np.asarray(read_array(one), float) for one in sorted(folder.glob("imat*.npy"))}
    mean, scatter = night.mean(axis=0), night.std(axis=0, ddof=1)
    rms = float(np.sqrt(np.square(mean).mean()))

    pairs = [correlation(night[i], night[j]) for i in range(len(night)) for j in range(i)]
    signal_to_noise = np.sqrt(np.square(mean).mean(axis=0) / np.square(scatter).mean(axis=0))
    document = {
        "n_matrices": len(night), "scatter_of_elements": float(np.sqrt(np.square(scatter).mean())) / rms,
        "correlation_of_pairs": [float(np.min(pairs)), float(np.median(pairs)), float(np.max(pairs))],
        "signal_to_noise_by_mode": np.round(signal_to_noise, 2).tolist(),
        "correlation_with_mean": {name: correlation(mean, one) for name, one in others.items()},
        "correlation_of_push_pull": {
            f"{a} and {b}": correlation(others[a], others[b])
            for a, b in zip(list(others)[1:], list(others)[2:], strict=False)
        },
    }  # fmt: skip
    return document, night, others


def draw(
    document: dict[str, Any], measured: NDArray[np.float64], synthetic: NDArray[np.float64],
    night: NDArray[np.float64], path: Path,
) -> None:  # fmt: skip
    """Elements, gains of the actuators, residual by actuator, and the DO-CRIME matrices."""
    figure = style.new_figure(9.6, 7.2)
    elements, gains, left, scatter = figure.subplots(2, 2).ravel()
    elements.plot(synthetic.ravel(), measured.ravel(), ".", ms=1.5, color=style.SERIES[0])
    elements.set(xlabel="synthetic slope", ylabel="measured slope", title="elements, 2025-09-10")
    for number, file in enumerate(_MATRICES):
        values = document[file]["actuator_gain"]
        gains.plot(values, "o-", ms=3, lw=0.8, color=style.SERIES[number], label=file[-13:-4])
    gains.set(xlabel="actuator", ylabel="fitted gain", title="gain relative to the measured surface")
    gains.legend(fontsize=7, frameon=False)
    ratio = np.linalg.norm(measured - synthetic, axis=0) / np.linalg.norm(measured, axis=0)
    left.bar(np.arange(ratio.size), 100 * ratio, color=style.SERIES[2])
    left.set(xlabel="actuator", ylabel="left of the column [%]", title="residual, 2025-09-10")
    at, flat = np.arange(night[0].size), night.reshape(len(night), -1)
    scatter.errorbar(
        at, flat.mean(axis=0), flat.std(axis=0, ddof=1), fmt="o", ms=3, lw=0.8, color=style.SERIES[0]
    )
    scatter.set(xlabel="element", ylabel="slope", title=f"{len(night)} DO-CRIME matrices: mean and scatter")
    for axes in (elements, gains, left, scatter):
        style.style_axes(axes)
    path.write_bytes(style.png(figure, dpi=100))


def main() -> None:
    """Fit, compare, draw."""
    parser = study_parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help=f"folder with {_SURFACES}")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    document, measured, synthetic = fit(options.data)
    document["felix"], night, _ = felix(options.data / "felix")
    (options.out / "irtf.json").write_text(dumps(document) + "\n")
    draw(document, measured, synthetic, night, options.out / "irtf.png")
    print(dumps(document))


if __name__ == "__main__":
    main()
