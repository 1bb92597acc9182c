"""One calibration of the small twin, shared by the tests that modify a valid one."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from small_bench import small

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.sensor import SubApertureGrid
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.acquisition.model_psf import measure_model_psf
from escape_hw.calibration.docrime.open_loop import DocrimeRun, docrime_run
from escape_hw.runtime.session.record import without_turbulence
from escape_hw.runtime.session.system import System
from escape_sim.atmosphere.phase_plates import von_karman_screen


@pytest.fixture(scope="session", autouse=True)
def _quick_benches() -> Iterator[None]:
    """Plates are made once per seed and detectors keep less noise in store: a bench opens at once."""
    plates: dict[object, np.ndarray] = {}

    def remembered(pixels: int, pixel_m: float, r0_m: float, outer_m: float, rng: np.random.Generator):
        key = (pixels, pixel_m, r0_m, outer_m, str(rng.bit_generator.state))
        if key not in plates:
            plates[key] = von_karman_screen(pixels, pixel_m, r0_m, outer_m, rng)
        # The caller scales it in place.
        return plates[key].copy()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("escape_sim.atmosphere.phase_plates.von_karman_screen", remembered)
        patch.setattr("escape_sim.optics.detector.Detector.POOL", 1 << 19)
        yield


@dataclass(frozen=True)
class Good:
    """A good DO-CRIME run, with the model on its grid and the PSF without turbulence."""

    run: DocrimeRun
    model: SyntheticModel
    psf: np.ndarray

    @property
    def matrix(self) -> InteractionMatrix:
        return self.run.result.matrix

    @property
    def grid(self) -> SubApertureGrid:
        return self.run.result.grid


@pytest.fixture(scope="session")
def good() -> Good:
    with small("twin.loss_probability=0") as bench:
        run = bench.run(docrime_run(bench, frames=4000))
        with without_turbulence(bench):
            psf = bench.run(measure_model_psf(bench, frames=5))
        return Good(run, bench.model(run.result.grid), psf)


@pytest.fixture(scope="module")
def shared() -> Iterator[System]:
    """One open bench for tests that leave it as they found it."""
    with small("twin.loss_probability=0") as bench:
        yield bench


@pytest.fixture
def bench() -> Iterator[System]:
    """A bench of one's own."""
    with small("twin.loss_probability=0") as bench:
        yield bench
