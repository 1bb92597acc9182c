"""SPRINT on matrices measured with a real ALPAO DM97, which are not part of the repository.

Its influence functions are no Gaussians, so the share of the broad pedestal ends at its limit.
"""

from __future__ import annotations

import gzip
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run
from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.calibration.sprint.fit import fit_registration
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import ShackHartmannModel

SHARED = Path(os.environ.get("ESCAPE_SHARED_DATA", Path(__file__).parents[3] / "shared" / "data"))
FOLDER = SHARED / "dm97"
#: One date for each of the three masks.
DATES = ("20230901150923", "20231214151118", "20231219151519")
#: Lenslets across, with one more at each rim than the camera's, for the largest mask reaches beyond its own.
ACROSS = 31
#: Pixels on the camera for a wavefront slope of one radian, and between lenslets.
PER_RADIAN, PITCH = 2654.5, 300 / 5.5
#: Noise of an element in pixels per unit command, as repeats have it.
NOISE = 0.26
DESIGN = (
    "system.wavelength_m=755e-9", f"system.pupil_m={ACROSS * 0.3e-3}", f"sensor.n_sub={ACROSS}",
    f"sensor.pitch_px={PITCH}", "sensor.spot_px=7.0", "sensor.beam_radius_m=inf",
    "devices.wfs.sensor_px=[2048,2048]", "devices.wfs.region=[0,0,2048,2048]", "devices.wfs.bit_depth=12",
    # A beam of 9 mm for 13.5 mm of the mirror: an actuator's pitch is one of 1 mm.
    f"devices.dm.pitches_across_pupil={ACROSS * 0.3}",
)  # fmt: skip

pytestmark = pytest.mark.skipif(
    not (FOLDER / "dm97.json").is_file(), reason=f"no measured matrices in {FOLDER} (ESCAPE_SHARED_DATA)"
)


class Levelled:
    """A model whose slopes have no mean, as those of the measured frames have none."""

    def __init__(self, inner: ShackHartmannModel) -> None:
        self._inner = inner

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> np.ndarray:
        return level(self._inner.zonal_matrix(registration, width))

    def zonal_jacobian(self, registration: Registration, width: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
        matrix, moved = self._inner.zonal_jacobian(registration, width)
        return level(matrix), level(moved)

    def modal_matrix(self, registration: Registration, m2c: np.ndarray, width: float = 1.0) -> np.ndarray:
        return level(self._inner.modal_matrix(registration, m2c, width))

    def modal_jacobian(
        self, registration: Registration, m2c: np.ndarray, width: float = 1.0
    ) -> tuple[np.ndarray, np.ndarray]:
        matrix, moved = self._inner.modal_jacobian(registration, m2c, width)
        return level(matrix), level(moved)

    def variants(self) -> list[Levelled]:
        return [Levelled(variant) for variant in self._inner.variants()]

    def __getattr__(self, name: str) -> Any:
        return getattr(self._inner, name)


def level(slopes: np.ndarray) -> np.ndarray:
    """Slopes ``(..., n_slopes, n)`` less the mean along x, and along y."""
    axes = slopes.reshape(*slopes.shape[:-2], 2, -1, slopes.shape[-1])
    return (axes - axes.mean(axis=-2, keepdims=True)).reshape(slopes.shape)


def measured(date: str) -> InteractionMatrix:
    """A date's matrix in pixels per unit command, the actuators in our order."""
    told = json.loads((FOLDER / "dm97.json").read_text())
    entry = next(one for one in told["entries"] if one["date"] == date)
    with gzip.open(FOLDER / entry["file"]) as packed:
        theirs = np.load(packed)
    data = np.empty_like(theirs)
    data[:, told["matrix"]["escape_order"]] = PER_RADIAN * theirs
    seen = np.loadtxt(FOLDER / f"mask_{entry['n_valid']}.txt").astype(bool)
    valid = np.pad(seen, (ACROSS - len(seen)) // 2)
    sigma, single = np.full(data.shape, NOISE, np.float32), np.eye(data.shape[1])
    return InteractionMatrix(data, sigma, single, valid, "ciao", "push-pull", False)


@pytest.mark.parametrize("date", DATES)
def test_the_fit_of_a_measured_mirror_converges(date: str) -> None:
    matrix = measured(date)
    n_valid, first = int(matrix.valid.sum()), (2048 - PITCH * (ACROSS - 1)) / 2
    references, light = np.zeros((n_valid, 2), np.float32), matrix.valid.astype(np.float32)
    grid = SubApertureGrid(PITCH, (first, first), matrix.valid, references, light, 0.0)
    fit = run(
        fit_registration(
            matrix, Levelled(make_fast_model(load_system("razor-shwfs", overrides=DESIGN), grid))
        )
    )
    assert fit.estimate.converged, fit.estimate.warnings
    left = np.linalg.norm(matrix.data - fit.zonal_matrix()) / np.linalg.norm(matrix.data)
    assert left < 0.25
