"""A sensor far from its model: the variants have large amplitudes, correlated with the gain."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.procedure import run
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.modes.bases import karhunen_loeve
from escape_hw.calibration.sprint.fit import fit_registration
from escape_hw.calibration.sprint.forwarding import Forwarding
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model
from escape_sim.models.shack_hartmann import nominal_grid

SMALL = (
    "sensor.n_sub=12", "devices.wfs.region=[220,156,200,200]", 'devices.dm.layout="circle-7"',
    "devices.dm.pitches_across_pupil=5.0", "basis.n_modes=25", "loop.dropped_modes=0",
)  # fmt: skip
#: Amplitude of the variant, in prior standard deviations, and gain: as of a pyramid in weaker turbulence.
SHARE, GAIN = -7.0, 0.5


@dataclass
class Dull:
    """A model whose sensor is less sensitive, and sees each actuator a second time beside it."""

    sharp: SyntheticModel

    def zonal_matrix(self, registration: Registration, width: float = 1.0) -> NDArray[np.float64]:
        aside = replace(registration, shift_x=registration.shift_x + 60.0)
        return np.asarray(
            0.8 * self.sharp.zonal_matrix(registration, width) + 0.1 * self.sharp.zonal_matrix(aside, width)
        )


class ModelWithVariant(Forwarding):
    """A model with one variant, of a less sensitive sensor."""

    def variants(self) -> list[Dull]:
        return [Dull(self.original)]


@pytest.mark.parametrize(
    "seed", [0, 1, *(pytest.param(seed, marks=pytest.mark.slow) for seed in range(2, 6))]
)
def test_large_amplitudes_are_fitted_with_the_registration(seed: int) -> None:
    config = load_system("razor-shwfs", overrides=SMALL)
    sharp = make_fast_model(config, None)
    m2c = karhunen_loeve(*sharp.influence_functions(), 25, 4 * config.system.pupil_m)
    rng = np.random.default_rng(seed)
    injected = Registration(*(rng.uniform(-1, 1, 5) * (40.0, 40.0, 1.5, 3.0, 3.0)))
    there = sharp.zonal_matrix(injected)
    exact = GAIN * (there + SHARE * (Dull(sharp).zonal_matrix(injected) - there)) @ m2c
    sigma = np.full(exact.shape, 0.05 * exact.std(), np.float32)
    data = (exact + sigma * rng.standard_normal(exact.shape)).astype(np.float32)
    matrix = InteractionMatrix(data, sigma, m2c, nominal_grid(config).valid, "razor-shwfs", "docrime", True)
    estimate = run(fit_registration(matrix, ModelWithVariant(sharp))).estimate
    assert estimate.converged, estimate.warnings
    # 26 at most of these six; 21 with Gaussian influence functions.
    assert len(estimate.iterations) <= 30
    pulls = (estimate.registration.to_array() - injected.to_array()) / np.sqrt(np.diag(estimate.covariance))
    assert np.abs(pulls).max() < 4.5
