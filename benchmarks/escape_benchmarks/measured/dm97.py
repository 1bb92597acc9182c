"""Interaction matrices of a real ALPAO DM97-15 with a Shack-Hartmann sensor.

From the repository rjonnal/ciao3 (commit 62b3f629), as 32-bit arrays with a description, ``dm97.json``. The
slopes have no tip and tilt; the largest mask reaches beyond the 29 x 29 lenslets of the camera.
"""

from __future__ import annotations

import gzip
import json
from pathlib import Path
from typing import Any

import numpy as np

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.sprint.fit import SprintFit, fit_registration
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model

#: Lenslets across, with one more at each rim than the camera has.
ACROSS = 31
#: Pixels on the camera for a wavefront slope of one radian, and between lenslets.
_PER_RADIAN, _PITCH, _CAMERA = 2654.5, 300 / 5.5, 2048
#: Noise of an element in pixels per unit command, from the repeats of a matrix.
NOISE = 0.26
_DESIGN = (
    "system.wavelength_m=755e-9", f"system.pupil_m={ACROSS * 0.3e-3}", f"sensor.n_sub={ACROSS}",
    f"sensor.pitch_px={_PITCH}", "sensor.spot_px=7.0", "sensor.beam_radius_m=inf",
    "devices.wfs.sensor_px=[2048,2048]", "devices.wfs.region=[0,0,2048,2048]", "devices.wfs.bit_depth=12",
    # A beam of 9 mm shows 13.5 mm of the mirror, so the pitch of an actuator is 1 mm on the lenslets.
    f"devices.dm.pitches_across_pupil={ACROSS * 0.3}",
)  # fmt: skip


def read_entries(folder: Path) -> list[dict[str, Any]]:
    """The matrices' descriptions: date, file, number of valid lenslets, whether the mirror moved."""
    entries: list[dict[str, Any]] = json.loads((folder / "dm97.json").read_text())["entries"]
    return entries


def read_matrix(folder: Path, date: str) -> InteractionMatrix:
    """A date's matrix in pixels per unit command, actuators in ESCAPE's order."""
    description = json.loads((folder / "dm97.json").read_text())
    entry = next(one for one in description["entries"] if one["date"] == date)
    with gzip.open(folder / entry["file"]) as packed:
        columns = np.load(packed)
    data = np.empty_like(columns)
    data[:, description["matrix"]["escape_order"]] = _PER_RADIAN * columns
    mask = np.loadtxt(folder / f"mask_{entry['n_valid']}.txt").astype(bool)
    valid = np.pad(mask, (ACROSS - len(mask)) // 2)
    sigma, single = np.full(data.shape, NOISE, np.float32), np.eye(data.shape[1])
    return InteractionMatrix(data, sigma, single, valid, "ciao", "push-pull", False)


def make_model(matrix: InteractionMatrix) -> SyntheticModel:
    """The synthetic model of the nominal design: a Gaussian mirror of coupling 0.4."""
    first = (_CAMERA - _PITCH * (ACROSS - 1)) / 2
    references = np.zeros((int(matrix.valid.sum()), 2), np.float32)
    light = matrix.valid.astype(np.float32)
    grid = SubApertureGrid(_PITCH, (first, first), matrix.valid, references, light, 0.0)
    return make_fast_model(load_system("razor-shwfs", overrides=_DESIGN), grid)


def fit_matrix(matrix: InteractionMatrix) -> SprintFit:
    """SPRINT's fit of that model."""
    return run(fit_registration(matrix, make_model(matrix)))
