"""The published zonal matrix of MAPS' visible arm beside the synthetic one of ``maps-vis``.

    python benchmarks/studies/maps_matrix.py --data ../shared/data/maps --out docs/studies/maps-matrix

Fits the registration with the registration-only solver, and draws both matrices in the system's 100 modes.
Writes ``maps.json`` and ``maps-matrices.png``. Takes a minute.
"""

from __future__ import annotations

import tempfile
from pathlib import Path

import numpy as np
from matrix_agreement import correlation
from numpy.typing import NDArray
from realisation_tables import study_parser

from escape_hw.api.registration import Registration
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
from escape_hw.report.figures.matrix import mode_maps
from escape_hw.runtime.session.array_target import array_target
from escape_sim.models.factory import make_fast_model

#: Pixels across the illuminated pupil of the published maps, of 36, and least rms response of a valid one.
ACROSS, LEAST = 28, 0.6e-4
#: Actuators fitted, those with the strongest response.
N_FITTED = 120
_FILE = "respM.fits.fz"


def illuminated(maps: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Pixels that respond, within the pupil; ``maps (n_act, n, 2 n)``."""
    n = maps.shape[1]
    response = np.sqrt((maps.reshape(len(maps), n, 2, n) ** 2).mean(axis=(0, 2)))
    line = np.arange(n) - (n - 1) / 2
    return np.asarray((response > LEAST) & (np.hypot(line, line[:, None]) < ACROSS / 2))


def main() -> None:
    """Import, fit, compare, draw."""
    parser = study_parser(__doc__)
    parser.add_argument("--data", type=Path, required=True, help=f"folder with {_FILE}")
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    config = load_system(
        "maps-vis", overrides=[f"sensor.n_sub={ACROSS}", "devices.dm.limits.disabled=[]", "basis.n_modes=100"]
    )
    with tempfile.TemporaryDirectory() as folder:
        mask = Path(folder) / "mask.npy"
        np.save(mask, illuminated(np.asarray(read_array(options.data / _FILE), float)))
        # The camera is turned by 180 degrees and its y slopes have the opposite polarity.
        description = ArrayDescription(
            matrix=MatrixTable(order="maps-beside", simulated=False),
            sensor=SensorTable(valid=str(mask), flip_x=True, flip_y=True, sign_y=-1),
        )
        result = import_arrays(description, Path(folder), array_target(config), options.data / _FILE)
    matrix, model = result.matrix, make_fast_model(config, result.grid)
    estimate = sprint(matrix, model, solver="registration-only", modes=N_FITTED)
    synthetic = model.zonal_matrix(estimate.registration)
    unshifted = model.zonal_matrix(Registration())
    n = matrix.n_slopes // 2
    document = {
        "registration": estimate.registration.to_array().tolist(), "sigma": estimate.sigma.tolist(),
        "converged": estimate.converged, "warnings": list(estimate.warnings), "n_valid": n,
        "correlation": {
            "fitted": correlation(matrix.data, synthetic),
            "fitted x": correlation(matrix.data[:n], synthetic[:n]),
            "fitted y": correlation(matrix.data[n:], synthetic[n:]),
            "unshifted": correlation(matrix.data, unshifted),
        },
    }  # fmt: skip
    m2c = build_basis(config, *model.influence_functions(), ())
    modal = {
        label: type(matrix)(
            (data @ m2c).astype(np.float32), np.zeros((2 * n, m2c.shape[1]), np.float32), m2c, matrix.valid,
            config.system.name, "push-pull", label != "published", slope_unit=matrix.slope_unit,
        )
        for label, data in (("published", matrix.data), ("synthetic", synthetic))
    }  # fmt: skip
    by_mode = [
        correlation(a, b) for a, b in zip(modal["published"].data.T, modal["synthetic"].data.T, strict=True)
    ]
    document["correlation by mode"] = by_mode
    (options.out / "maps-matrices.png").write_bytes(style.png(mode_maps(modal), dpi=100))
    (options.out / "maps.json").write_text(dumps(document) + "\n")
    print(dumps({**document, "correlation by mode": np.round(by_mode, 2).tolist()}))


if __name__ == "__main__":
    main()
