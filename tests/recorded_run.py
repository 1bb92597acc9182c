"""A finished run on a small sensor, as a folder: three matrices, SPRINT, optical gains, a loop, a track."""

from __future__ import annotations

from pathlib import Path

import fake_results as fake
import numpy as np

from escape_hw.api.registration import PARAMETERS
from escape_hw.io import documents
from escape_hw.io.fits.gains import save_gains
from escape_hw.io.fits.loop import save_loop
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.io.run_folder import RunFolder

N_SUB, N_MODES = 12, 20


def calibration(method: str):
    return fake.calibration(method, n=N_SUB, n_modes=N_MODES)


def make_run(folder: Path) -> Path:
    """Write it; the folder."""
    with RunFolder("razor-shwfs", "test", folder) as run:
        run.write_config("schema = 1\n")
        for method in ("push-pull", "docrime-whitened", "escape"):
            name = method.replace("-", "_")
            run.add_product(name, save_matrix(run.file(f"{name}.fits"), calibration(method), fake.ORIGIN))
        gains = save_gains(run.file("gains.fits"), fake.gains_result(), "razor-shwfs", True, fake.ORIGIN)
        run.add_product("gains", gains)
        run.add_product(
            "loop", save_loop(run.file("loop.fits"), fake.loop(), "razor-shwfs", True, fake.ORIGIN)
        )
        document = {
            **documents.header_fields("calibrate", "razor-shwfs", True, 1),
            "title": "A run",
            **documents.calibration_document(calibration("escape")),
            "track": track(),
            "exchanges": [{"seconds": 300.0, "accepted": True}],
            "alarms": [],
            "bench": {"layout": ["".join("1" if one else "0" for one in row) for row in fake.layout()]},
        }
        run.write_result(document)
    return run.path


def track(n: int = 50) -> dict[str, list[float]]:
    """A mirror that drifts by 1 % of a sub-aperture a minute."""
    seconds = np.linspace(0, 600, n)
    columns = {"seconds": seconds}
    for name in PARAMETERS:
        columns[name] = fake.INJECTED.to_dict()[name] + (seconds / 60 if name == "shift_x" else 0 * seconds)
        columns[f"{name}_sigma"] = np.full(n, 0.1)
    return {name: column.tolist() for name, column in columns.items()}
