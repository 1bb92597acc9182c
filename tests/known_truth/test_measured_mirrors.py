"""SPRINT on matrices of a real ALPAO DM97, which are next to the project and not in it.

Its influence functions are rounded exponentials and its slopes have no tip and tilt.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from shared_data import SHARED, shared_data

from escape_benchmarks.measured.dm97 import fit_matrix, load_design, read_calibration, read_matrix
from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.results import find_outliers
from escape_hw.api.sensor import SubApertureGrid, require_kind
from escape_hw.calibration.sprint.fit import SprintFit, sprint
from escape_hw.config.loader import load_system
from escape_hw.io.interchange.arrays import design_geometry, import_arrays, read_description
from escape_hw.report.comparison import changed_gains
from escape_hw.runtime.session.array_target import array_target
from escape_sim.models.factory import make_fast_model

FOLDER = SHARED / "dm97"
#: One date for each of the three masks.
DATES = ("20230901151403", "20231214151118", "20231219151519")
#: Room for pupil images of 36 pixels.
_PUPILS = "sensor.pupils_px=[[69.0,35.0],[111.0,35.0],[69.0,78.0],[109.0,77.0]]"

pytestmark = pytest.mark.skipif(
    not (FOLDER / "dm97.json").is_file(), reason=f"no measured matrices in {FOLDER} (ESCAPE_SHARED_DATA)"
)


@cache
def fitted(date: str) -> tuple[InteractionMatrix, SprintFit]:
    """The matrix of a date and SPRINT's fit to it."""
    matrix = read_matrix(FOLDER, date)
    return matrix, fit_matrix(matrix)


@pytest.mark.parametrize(
    "date", [DATES[0], *(pytest.param(date, marks=pytest.mark.slow) for date in DATES[1:])]
)
def test_the_fit_of_a_measured_mirror_converges(date: str) -> None:
    matrix, fit = fitted(date)
    assert fit.estimate.converged, fit.estimate.warnings
    assert any("tip and tilt" in note for note in fit.estimate.notes)
    left = np.linalg.norm(matrix.data - fit.zonal_matrix()) / np.linalg.norm(matrix.data)
    assert left < 0.08


def test_a_measured_mirror_without_standard_errors_gives_the_same() -> None:
    matrix, fit = fitted(DATES[0])
    other = fit_matrix(replace(matrix, sigma=np.zeros_like(matrix.sigma))).estimate
    assert other.converged
    difference = other.registration.to_array() - fit.estimate.registration.to_array()
    assert np.abs(difference / fit.estimate.sigma).max() < 0.3


def test_a_mask_that_reaches_beyond_the_described_lenslets_does_not_fit() -> None:
    """The largest mask on the camera's 29 lenslets across: those at the rim are dark in the model."""
    date, across = DATES[2], 29
    config = load_design([
        f"sensor.n_sub={across}", f"system.pupil_m={across * 0.3e-3}",
        f"devices.dm.pitches_across_pupil={across * 0.3}",
    ])  # fmt: skip
    correct = read_calibration(FOLDER, date)
    valid = correct.matrix.valid[1:-1, 1:-1]
    assert valid.sum() == correct.matrix.valid.sum()
    matrix = replace(correct.matrix, valid=valid)
    model = make_fast_model(
        config, require_kind(design_geometry(valid, array_target(config)), SubApertureGrid)
    )
    estimate = sprint(matrix, model)
    assert estimate.converged, estimate.warnings
    assert estimate.model_fits is False
    assert any("hardly respond" in note for note in estimate.notes)
    assert any("the largest residuals are those of sub-apertures" in note for note in estimate.notes)
    assert find_outliers(estimate.goodness_of_fit.by_sub_aperture)
    # The errors contain what the misfit does to the registration.
    fitting = fitted(date)[1].estimate
    error = estimate.registration.to_array() - fitting.registration.to_array()
    assert (np.abs(error) < 2 * estimate.sigma).all()


@pytest.mark.slow
def test_matrices_minutes_apart_agree() -> None:
    (_, a), (second, b) = fitted(DATES[0]), fitted("20230901151656")
    difference = a.estimate.registration.to_array() - b.estimate.registration.to_array()
    # In % of a sub-aperture, degrees and % of the diameter: less than the uncertainty of the registration.
    assert (np.abs(difference) < [1.0, 1.0, 0.02, 0.15, 0.15]).all()
    # Between runs of one set-up it is known ten times better, and they agree within that.
    between = [one.estimate.repeatability_sigma for one in (a, b)]
    assert between[0] is not None
    assert between[1] is not None
    assert (between[0] < 0.4 * a.estimate.sigma).all()
    chi2 = np.square(difference / np.hypot(*between)).mean()
    assert 0.1 < chi2 < 2.0, difference / np.hypot(*between)
    left = np.linalg.norm(second.data - a.zonal_matrix()) / np.linalg.norm(second.data)
    assert left < 0.08


@pytest.mark.slow
def test_broken_lenslets_are_named() -> None:
    estimate = fitted("20230724164246")[1].estimate
    assert not estimate.converged
    assert "does not fit" in estimate.warnings[0]
    assert "sub-apertures" in estimate.warnings[0]


@pytest.mark.slow
@pytest.mark.parametrize("date", ["20231214125445", "20231214132404"])
def test_a_mirror_that_did_not_move_is_refused(date: str) -> None:
    estimate = fitted(date)[1].estimate
    assert not estimate.converged, estimate
    assert "does the mirror move" in estimate.warnings[0]


@pytest.mark.slow
def test_an_actuator_whose_gain_changes_is_named() -> None:
    gains = [
        fitted(date)[1].estimate.actuator_corrections.gain for date in ("20230927150437", "20230927151155")
    ]
    assert next(iter(changed_gains(*gains))) == 23


@pytest.mark.parametrize(
    ("description", "system", "shape"),
    [
        ('file = "irtf/imat.12x12.20250910a.npy"\n[sensor]\nvalid = "irtf/validSubAps_12x12.npy"',
         ("razor-shwfs", "sensor.n_sub=12", "devices.dm.layout=square-6", "basis.n_modes=36"), (232, 36)),
        ('file = "maps/respM.fits.fz"\norder = "maps-beside"\n[sensor]\nvalid = "nonzero"',
         ("maps-vis", "sensor.n_sub=36", _PUPILS), (2592, 336)),
        ('file = "maps/MAPS-RMWFS.fits.fz"\norder = "maps-beside"\n[sensor]\nvalid = "nonzero"\n'
         '[modes]\nfile = "maps/full_maps_m2c.fits"',
         ("maps-vis", "sensor.n_sub=36", _PUPILS), (2592, 335)),
    ],
)  # fmt: skip
def test_matrices_of_other_systems_are_imported(description, system, shape, tmp_path) -> None:
    shared_data(description.partition('"')[2].partition("/")[0])
    path = tmp_path / "matrix.toml"
    path.write_text(f"[matrix]\nsimulated = false\n{description}\n")
    config = load_system(system[0], overrides=system[1:])
    matrix = import_arrays(read_description(path), SHARED, array_target(config)).matrix
    assert matrix.data.shape == shape
    assert matrix.m2c.shape[0] == config.devices.dm.n_act
    assert not matrix.simulated
    assert np.abs(matrix.data).max() > 0
