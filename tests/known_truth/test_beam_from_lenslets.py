"""The model of a Shack-Hartmann sensor has the beam that the light of the lenslets shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from escape_hw.api.registration import Registration
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.config.loader import load_system
from escape_hw.config.system import SystemConfig
from escape_sim.models.shack_hartmann import ShackHartmannModel, nominal_grid
from escape_sim.optics.pupil import pupil_from_lenslets, pupil_geometry, true_pupil

SYSTEM = load_system("razor-shwfs")
#: Narrower than described, and off centre by a tenth of the pupil's radius.
TRUE = ("twin.beam.radius_m=4.2e-3", "twin.beam.centre_m=[3.4e-4,-2.0e-4]")


def lit_by(config: SystemConfig, noise: float = 0.0) -> SubApertureGrid:
    """The nominal grid with the light of the twin's beam; a dirty lenslet if there is noise."""
    grid, pupil = nominal_grid(config), true_pupil(config)
    n, p = pupil.n_sub, pupil.n_pix
    flux = np.square(pupil.amplitude, dtype=float).reshape(n, p, n, p).sum(axis=(1, 3))
    if noise:
        flux *= 1 + noise * np.random.default_rng(4).standard_normal(flux.shape)
        flux[9, 14] *= 0.3
    return replace(grid, flux=(flux / np.percentile(flux[flux > 0], 95)).astype(np.float32), counts=20000.0)


@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 2e-3), (0.03, 0.01)])
def test_the_beam_is_found(noise: float, tolerance: float) -> None:
    config = load_system("razor-shwfs", overrides=TRUE)
    found, true = pupil_from_lenslets(config, lit_by(config, noise)).amplitude, true_pupil(config).amplitude
    assert np.abs(found - true / true.max()).max() < tolerance
    assert np.abs(pupil_geometry(config).amplitude - true / true.max()).max() > 0.1


def test_the_matrix_is_that_of_the_true_beam() -> None:
    """Without the light of the lenslets it is that of a mirror shifted and scaled by far more."""
    described = load_system("razor-shwfs", overrides=["sensor.beam_radius_m=4.2e-3"])
    grid = lit_by(load_system("razor-shwfs", overrides=TRUE[:1]))
    unknown = replace(grid, flux=nominal_grid(SYSTEM).flux)
    right, found, nominal = (
        ShackHartmannModel(config, lit).zonal_matrix(Registration(-16.0, 31.0, -0.77, 2.9, 0.5))
        for config, lit in ((described, grid), (SYSTEM, grid), (SYSTEM, unknown))
    )
    assert np.linalg.norm(found - right) < 0.1 * np.linalg.norm(nominal - right)


def test_without_counts_the_light_is_not_known() -> None:
    grid = replace(lit_by(load_system("razor-shwfs", overrides=TRUE)), counts=0.0)
    assert np.array_equal(pupil_from_lenslets(SYSTEM, grid).amplitude, pupil_geometry(SYSTEM).amplitude)
