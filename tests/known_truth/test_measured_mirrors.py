"""SPRINT on matrices measured with a real ALPAO DM97, which are not part of the repository.

Its influence functions are rounded exponentials and its slopes have no tip and tilt.
"""

from __future__ import annotations

import gzip
import json
import os
from pathlib import Path

import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.calibration.sprint.fit import SprintFit, fit_registration
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model

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


def fitted(date: str) -> tuple[InteractionMatrix, SprintFit]:
    """The matrix of a date and SPRINT's fit to it."""
    matrix = measured(date)
    n_valid, first = int(matrix.valid.sum()), (2048 - PITCH * (ACROSS - 1)) / 2
    references, light = np.zeros((n_valid, 2), np.float32), matrix.valid.astype(np.float32)
    grid = SubApertureGrid(PITCH, (first, first), matrix.valid, references, light, 0.0)
    model = make_fast_model(load_system("razor-shwfs", overrides=DESIGN), grid)
    return matrix, run(fit_registration(matrix, model))


@pytest.mark.parametrize("date", DATES)
def test_the_fit_of_a_measured_mirror_converges(date: str) -> None:
    matrix, fit = fitted(date)
    assert fit.estimate.converged, fit.estimate.warnings
    assert any("tip and tilt" in note for note in fit.estimate.notes)
    left = np.linalg.norm(matrix.data - fit.zonal_matrix()) / np.linalg.norm(matrix.data)
    assert left < 0.08


def test_matrices_minutes_apart_agree() -> None:
    (_, a), (second, b) = fitted("20230901151403"), fitted("20230901151656")
    difference = a.estimate.registration.to_array() - b.estimate.registration.to_array()
    # In % of a sub-aperture, degrees and % of the diameter: less than the uncertainty of the registration.
    assert (np.abs(difference) < [1.0, 1.0, 0.02, 0.15, 0.15]).all()
    left = np.linalg.norm(second.data - a.zonal_matrix()) / np.linalg.norm(second.data)
    assert left < 0.08


def test_broken_lenslets_are_named() -> None:
    estimate = fitted("20230724164246")[1].estimate
    assert not estimate.converged
    assert "does not fit" in estimate.warnings[0]
    assert "sub-apertures" in estimate.warnings[0]


def test_a_mirror_that_did_not_move_is_refused() -> None:
    estimate = fitted("20231214125445")[1].estimate
    assert not estimate.converged, estimate
