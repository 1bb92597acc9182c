"""Interaction matrices of a real ALPAO DM97-15 with a Shack-Hartmann sensor.

From the repository rjonnal/ciao3 (commit 62b3f629), as 32-bit arrays with a description, ``dm97.json``. The
slopes have no tip and tilt; the largest mask reaches beyond the 29 x 29 lenslets of the camera.
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run
from escape_hw.api.results import CalibrationResult
from escape_hw.api.sensor import SubApertureGrid, require_kind
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.sprint.fit import SprintFit, fit_registration
from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig
from escape_hw.io.interchange.arrays import (
    ActuatorTable,
    ArrayDescription,
    MatrixTable,
    SensorTable,
    design_geometry,
    import_arrays,
)
from escape_hw.runtime.session.array_target import array_target
from escape_sim.models.factory import make_fast_model

#: Lenslets across, with one more at each rim than the camera has.
ACROSS = 31
#: Pixels on the camera for a wavefront slope of one radian, and between lenslets.
_PER_RADIAN, _PITCH = 2654.5, 300 / 5.5
#: Noise of an element in pixels per unit command, from the repeats of a matrix.
NOISE = 0.26
_DESIGN = (
    "system.wavelength_m=755e-9", f"system.pupil_m={ACROSS * 0.3e-3}", f"sensor.n_sub={ACROSS}",
    f"sensor.pitch_px={_PITCH}", "sensor.spot_px=7.0", "sensor.beam_radius_m=inf",
    "devices.wfs.sensor_px=[2048,2048]", "devices.wfs.region=[0,0,2048,2048]", "devices.wfs.bit_depth=12",
    # A beam of 9 mm shows 13.5 mm of the mirror, so the pitch of an actuator is 1 mm on the lenslets.
    f"devices.dm.pitches_across_pupil={ACROSS * 0.3}",
    "devices.dm.influence=gaussian", "devices.dm.coupling=0.4",
)  # fmt: skip


def read_entries(folder: Path) -> list[dict[str, Any]]:
    """The matrices' descriptions: date, file, number of valid lenslets, whether the mirror moved."""
    entries: list[dict[str, Any]] = json.loads((folder / "dm97.json").read_text())["entries"]
    return entries


def read_calibration(folder: Path, date: str) -> CalibrationResult:
    """A date's matrix in pixels per unit command, actuators in ESCAPE's order, with the nominal grid."""
    entry = next(one for one in read_entries(folder) if one["date"] == date)
    description = ArrayDescription(
        matrix=MatrixTable(file=entry["file"], scale=_PER_RADIAN, sigma=NOISE / _PER_RADIAN, simulated=False),
        sensor=SensorTable(valid=f"mask_{entry['n_valid']}.txt"),
        actuators=ActuatorTable(transpose=True, flip_x=True, flip_y=True),
    )
    return import_arrays(description, folder, array_target(_system()))


def read_matrix(folder: Path, date: str) -> InteractionMatrix:
    """The matrix of :func:`read_calibration`."""
    return read_calibration(folder, date).matrix


def make_model(matrix: InteractionMatrix) -> SyntheticModel:
    """The synthetic model of the nominal design: a Gaussian mirror of coupling 0.4."""
    grid = design_geometry(matrix.valid, array_target(_system()))
    return make_fast_model(_system(), require_kind(grid, SubApertureGrid))


def load_design(overrides: Sequence[str] = ()) -> SystemConfig:
    """The bench's configuration, with further overrides."""
    return load_system("razor-shwfs", overrides=(*_DESIGN, *overrides))


@cache
def _system() -> SystemConfig:
    return load_design()


def fit_matrix(matrix: InteractionMatrix) -> SprintFit:
    """SPRINT's fit of that model."""
    return run(fit_registration(matrix, make_model(matrix)))
