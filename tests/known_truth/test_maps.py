"""The telescope twins: the images are located correctly, and the loop closes on a star."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

import escape_hw
from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellState
from escape_hw.api.registration import Registration
from escape_sim.devices.bench import SimBench
from escape_sim.devices.twins import SimAdaptiveSecondary
from escape_sim.models.factory import make_fast_model

#: Few modes and weak turbulence for a short test with a sufficient signal-to-noise ratio in every mode.
FEW = [
    "basis.n_modes=20", "calibration.sprint_modes=20", "twin.atmosphere.r0_m=0.4", "calibration.frames=900",
]  # fmt: skip


@pytest.fixture(scope="module", params=["maps-nir", pytest.param("maps-vis", marks=pytest.mark.slow)])
def system(request) -> Iterator[escape_hw.System]:
    with escape_hw.open_system(request.param, seed=3, set=FEW) as opened:
        yield opened


@pytest.fixture(scope="module")
def found(system) -> escape_hw.CalibrationResult:
    return system.calibrate("docrime")


def twin(system) -> SimBench:
    assert isinstance(system.dm, SimAdaptiveSecondary)
    return system.dm._bench


def test_the_mirror_is_an_adaptive_secondary_that_runs(system):
    assert isinstance(system.dm, AdaptiveSecondary)
    assert system.dm.state is ShellState.RUNNING
    assert system.dm.info.n_act == 336
    assert twin(system).pupil.n_pix == 2


def test_frames_are_faint_but_not_dark_nor_saturated(system):
    system.dm.flatten()
    frame = system.wfs.next_frame(1.0)
    counts = frame.data.astype(float) - np.median(frame.data[38:42, :10])
    electrons = counts.sum() * system.config.twin.wfs.full_well_e / (2**14 - 1)
    expected = twin(system).wfs_light(system.wfs.settings.exposure_s)[0]
    assert frame.n_saturated == 0
    assert electrons == pytest.approx(expected, rel=0.15)
    # The contaminated arc is darker than the one opposite.
    passed = np.square(twin(system).pupil.amplitude, dtype=float)
    assert passed.sum() < 0.99 * (passed > 0).sum()


@pytest.mark.slow
def test_pupils_are_found_where_they_are(system, found):
    sensor, hidden = system.config.sensor, system.config.twin.pyramid
    centres = np.add(sensor.pupils_px, hidden.centre_offsets_px)
    assert np.abs(found.grid.centres_px - centres).max() < 0.6
    assert np.abs((found.grid.centres_px - centres).mean(axis=0)).max() < 0.3


@pytest.mark.slow
def test_the_matrix_has_the_hidden_registration(system, found):
    model = make_fast_model(system.config, found.grid)
    matrix = found.matrix

    def likeness(registration):
        want = model.zonal_matrix(registration) @ matrix.m2c
        return np.mean([np.corrcoef(a, b)[0, 1] for a, b in zip(want.T, matrix.data.T, strict=True)])

    injected = system.config.twin.registration.to_registration()
    flipped = Registration(*(-injected.to_array()))
    assert likeness(injected) > 0.5
    assert likeness(injected) > likeness(flipped)


@pytest.mark.slow
def test_disabled_actuators_take_no_part(system, found):
    disabled = list(system.config.devices.dm.limits.disabled)
    assert len(disabled) == 10
    assert not found.matrix.m2c[disabled].any()


@pytest.mark.slow
def test_the_loop_closes_on_the_star(system, found):
    model = system.take_model_psf()
    run = system.close_loop(found.matrix, found.grid, frames=500, model_psf=model)
    still = system.close_loop(found.matrix, found.grid, frames=500, model_psf=model, gain=1e-4)
    assert run.stable
    # With next to no gain the seeing stays as it is.
    assert 1.8 * still.strehl.peak.value < run.strehl.peak.value < 1.0


@pytest.mark.slow
def test_noise_does_not_lead_the_width_astray():
    """Most of the matrix is noise, and width and shape of the influence functions are nearly degenerate."""
    with escape_hw.open_system("maps-nir", seed=21) as system:
        found = system.calibrate("escape", frames=1500)
    assert found.registration is not None
    assert found.registration.converged
    assert found.registration.width.value == pytest.approx(1.03, abs=0.15)
