"""The published zonal matrix of MAPS' visible arm beside the twin's DO-CRIME matrix and the synthetic one.

    python benchmarks/studies/measured/maps_matrix.py --data ../shared/data/maps \\
        --out docs/studies/maps-matrix

Fits the registration of the published matrix with the registration-only solver, measures DO-CRIME on the twin
of ``maps-vis`` at that registration, and compares both with each other and with the synthetic matrix in the
first 100 modes of the published basis. Writes ``maps.json`` and ``maps-matrices.png``. With 10,000 frames it
takes six minutes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from astropy.io import fits
from maps_matrix_figure import draw
from numpy.typing import NDArray
from PIL import Image

from escape_benchmarks.matrix_agreement import correlation
from escape_benchmarks.realisation_tables import study_parser
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.pyramid import PyramidPupils
from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.results import CalibrationResult, RegistrationEstimate
from escape_hw.api.sensor import require_kind
from escape_hw.array_files import read_array
from escape_hw.calibration.modes.bases import build_basis
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.config.loader import load_system
from escape_hw.io.documents import dumps
from escape_hw.io.interchange.arrays import (
    ArrayDescription,
    MatrixTable,
    SensorTable,
    import_arrays,
)
from escape_hw.report.figures import style
from escape_hw.runtime.session.array_target import array_target
from escape_hw.runtime.session.system import open_system
from escape_sim.models.factory import make_fast_model

#: Pixels across the illuminated pupil of the published maps, of 36, and least rms response of a valid one.
ACROSS, LEAST = 28, 0.6e-4
#: Actuators fitted, those with the strongest response.
N_FITTED = 120
#: Modes compared, as in the paper's figure, and the last mode of each group of the table.
N_MODES, GROUPS = 100, (10, 30, 60, 100)
#: Slopes of an actuator below this fraction of the largest in the synthetic matrix are far from it.
FAR = 0.1
_FILE, _BASIS = "respM.fits.fz", "full_maps_m2c.fits"
#: The labels of the three matrices.
PUBLISHED, TWIN, SYNTHETIC = "published", "twin, DO-CRIME", "synthetic"
#: The published responses without those far from their actuators.
NEAR = "near"


def illuminated(maps: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels that respond, within the pupil; ``maps (n_act, n, 2 n)``."""
    n = maps.shape[1]
    response = np.sqrt((maps.reshape(len(maps), n, 2, n) ** 2).mean(axis=(0, 2)))
    line = np.arange(n) - (n - 1) / 2
    return np.asarray((response > LEAST) & (np.hypot(line, line[:, None]) < ACROSS / 2))


def published_settings(data: Path, folder: Path) -> list[str]:
    """Settings of ``maps-vis`` for the published maps: size of the pupil images, modes, all actuators."""
    modes = np.asarray(read_array(data / _BASIS), float)[:, :N_MODES]
    fits.writeto(folder / "basis.fits", modes)
    return [
        f"sensor.n_sub={ACROSS}", "devices.dm.limits.disabled=[]", "basis.kind=file",
        f"basis.file={folder / 'basis.fits'}", f"basis.n_modes={N_MODES}",
    ]  # fmt: skip


def import_published(data: Path, folder: Path, settings: list[str]) -> CalibrationResult:
    """The published zonal matrix in the orientation of ESCAPE."""
    np.save(folder / "mask.npy", illuminated(np.asarray(read_array(data / _FILE), float)))
    # The camera is turned by 180 degrees and its y slopes have the opposite polarity.
    description = ArrayDescription(
        matrix=MatrixTable(order="maps-beside", simulated=False),
        sensor=SensorTable(valid="mask.npy", flip_x=True, flip_y=True, sign_y=-1),
    )
    target = array_target(load_system("maps-vis", overrides=settings))
    return import_arrays(description, folder, target, data / _FILE)


def measure_twin(
    settings: list[str], registration: Registration, images: PyramidPupils, frames: int
) -> InteractionMatrix:
    """DO-CRIME in open loop on the twin, contaminated as bundled, with the published registration.

    The pupil images are exactly where the published settings have them, and their pixels are numbered as in
    the published maps, so that the same element of both matrices is the same pixel.
    """
    values = zip(PARAMETERS, registration.to_array(), strict=True)
    injected = [f"twin.registration.{name}={value:.6f}" for name, value in values]
    centred = f"twin.pyramid.centre_offsets_px={[[0, 0]] * 4}"
    with open_system("maps-vis", set=[*settings, *injected, centred]) as twin:
        found = require_kind(twin.find_sensor().grid, PyramidPupils)
        grid = replace(found, centres_px=images.centres_px, corners_px=images.corners_px)
        return twin.calibrate("docrime", frames=frames, grid=grid).matrix


def restrict(matrix: InteractionMatrix, valid: NDArray[np.bool_]) -> InteractionMatrix:
    """The matrix on a part of its sub-apertures."""
    rows = np.tile(valid[matrix.valid], 2)
    return replace(matrix, data=matrix.data[rows], sigma=matrix.sigma[rows], valid=valid)


def by_mode(a: InteractionMatrix, b: InteractionMatrix) -> NDArray[np.float64]:
    """Correlation of every mode of two matrices."""
    return np.array([correlation(x, y) for x, y in zip(a.data.T, b.data.T, strict=True)], float)


def pixel_noise(matrix: InteractionMatrix) -> NDArray[np.float64]:
    """Variance per mode of noise that is independent between pixels, from second differences of the maps."""
    maps = np.array([matrix.maps(mode) for mode in range(matrix.n_modes)])
    differences = [np.diff(maps, n=2, axis=axis).reshape(len(maps), -1) for axis in (2, 3)]
    # The weights of a second difference are 1, -2, 1.
    return np.asarray(np.nanmean(np.square(np.concatenate(differences, axis=1)), axis=1) / 6)


def shares(measured: InteractionMatrix, synthetic: InteractionMatrix) -> dict[str, NDArray[np.float64]]:
    """Parts of every mode's sum of squares: the synthetic mode times a factor, pixel noise, and the rest."""
    model, data = synthetic.data.astype(float), measured.data.astype(float)
    gain = (model * data).sum(axis=0) / np.square(model).sum(axis=0)
    remainder = replace(measured, data=data - gain * model)
    explained = by_mode(measured, synthetic) ** 2
    noise = pixel_noise(remainder) / np.square(data).mean(axis=0)
    return {"synthetic": explained, "noise": noise, "rest": 1 - explained - noise}


def share_in(matrix: InteractionMatrix, region: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Part of every mode's sum of squares that lies in a region of the pupil."""
    power = np.square(matrix.data, dtype=float)
    return np.asarray(power[np.tile(region[matrix.valid], 2)].sum(axis=0) / power.sum(axis=0))


def compare(matrices: Mapping[str, InteractionMatrix]) -> dict[str, NDArray[np.float64]]:
    """The columns of the table, by mode."""
    published, twin, synthetic = (matrices[label] for label in (PUBLISHED, TWIN, SYNTHETIC))
    line = np.arange(ACROSS) - (ACROSS - 1) / 2
    rim = np.hypot(line, line[:, None]) > ACROSS / 2 - 2
    corner = (line < 0) & (line[:, None] < 0)
    columns = {
        "correlation published twin": by_mode(published, twin),
        "correlation published synthetic": by_mode(published, synthetic),
        "correlation twin synthetic": by_mode(twin, synthetic),
        "twin stated noise": np.square(twin.sigma).mean(axis=0) / np.square(twin.data).mean(axis=0),
    }
    for label, matrix in ((PUBLISHED, published), (TWIN, twin)):
        columns |= {f"{label}: {part}": value for part, value in shares(matrix, synthetic).items()}
    for label, matrix in matrices.items():
        columns |= {f"{label}: rim": share_in(matrix, rim), f"{label}: upper left": share_in(matrix, corner)}
    return columns


def by_group(columns: Mapping[str, NDArray[np.float64]]) -> dict[str, dict[str, float]]:
    """Means over groups of modes."""
    edges = [*zip((0, *GROUPS), GROUPS, strict=False), (0, N_MODES)]
    return {
        name: {f"{a + 1}-{b}": round(float(values[a:b].mean()), 3) for a, b in edges}
        for name, values in columns.items()
    }


def zonal_document(
    matrix: InteractionMatrix, estimate: RegistrationEstimate, fitted: NDArray[Any], unshifted: NDArray[Any]
) -> dict[str, Any]:
    """The fit of the published matrix."""
    n = matrix.n_slopes // 2
    return {
        "registration": estimate.registration.to_array().tolist(), "sigma": estimate.sigma.tolist(),
        "converged": estimate.converged, "warnings": list(estimate.warnings), "n_valid": n,
        "correlation": {
            "fitted": correlation(matrix.data, fitted),
            "fitted x": correlation(matrix.data[:n], fitted[:n]),
            "fitted y": correlation(matrix.data[n:], fitted[n:]),
            "unshifted": correlation(matrix.data, unshifted),
        },
    }  # fmt: skip


def main() -> None:
    """Import, fit, measure, compare, draw."""
    parser = study_parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help=f"folder with {_FILE} and {_BASIS}")
    parser.add_argument("--frames", type=int, default=10000, help="frames of the twin's DO-CRIME")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as name:
        settings = published_settings(options.data, Path(name))
        result = import_published(options.data, Path(name), settings)
        config = load_system("maps-vis", overrides=settings)
        matrix, model = result.matrix, make_fast_model(config, result.grid)
        estimate = sprint(matrix, model, solver="registration-only", modes=N_FITTED)
        m2c = build_basis(config, *model.influence_functions(), ())
        images = require_kind(result.grid, PyramidPupils)
        twin = measure_twin(settings, estimate.registration, images, options.frames)
    synthetic = model.zonal_matrix(estimate.registration)
    near = np.abs(synthetic) > FAR * np.abs(synthetic).max(axis=0)
    matrices = {
        label: InteractionMatrix(
            (data @ m2c).astype(np.float32), np.zeros((matrix.n_slopes, N_MODES), np.float32), m2c,
            matrix.valid, config.system.name, "push-pull", label == SYNTHETIC, slope_unit=matrix.slope_unit,
        )
        for label, data in ((PUBLISHED, matrix.data), (NEAR, matrix.data * near), (SYNTHETIC, synthetic))
    }  # fmt: skip
    common = matrix.valid & twin.valid
    matrices = {label: restrict(one, common) for label, one in {**matrices, TWIN: twin}.items()}
    published_near = matrices.pop(NEAR)
    matrices = {label: matrices[label] for label in (PUBLISHED, TWIN, SYNTHETIC)}
    columns = compare(matrices)
    columns["correlation near synthetic"] = by_mode(published_near, matrices[SYNTHETIC])
    document = {
        **zonal_document(matrix, estimate, synthetic, model.zonal_matrix(Registration())),
        "frames": options.frames, "n_valid_twin": int(twin.valid.sum()), "n_common": int(common.sum()),
        "near": {
            "elements": float(near.mean()),
            "published": float(np.square(matrix.data[near]).sum() / np.square(matrix.data).sum()),
            "synthetic": float(np.square(synthetic[near]).sum() / np.square(synthetic).sum()),
        },
        "by group": by_group(columns),
        "by mode": {name: np.round(values, 4).tolist() for name, values in columns.items()},
    }  # fmt: skip
    picture = Image.open(BytesIO(style.png(draw(matrices, columns), dpi=140))).convert("RGB")
    # A palette makes the file a third as large; this one keeps the colours of thin lines.
    picture.quantize(256, Image.Quantize.MAXCOVERAGE).save(options.out / "maps-matrices.png", optimize=True)
    (options.out / "maps.json").write_text(dumps(document) + "\n")
    print(dumps({name: value for name, value in document.items() if name != "by mode"}))


if __name__ == "__main__":
    main()
