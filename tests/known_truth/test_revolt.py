"""The twin of REVOLT: valid lenslets, the delays of both controllers, registration and loop on a star."""

from __future__ import annotations

import numpy as np
import pytest

import escape_hw

#: Few modes at a higher poke, and weak turbulence: a short test.
FEW = ["basis.n_modes=20", "calibration.sprint_modes=20", "loop.dropped_modes=0", "calibration.poke=0.02"]
#: Latency of the real-time computer in the system file, and of pyRTC.
CONTROLLERS = {1: 5.0e-5, 3: 4.05e-3}


@pytest.fixture(scope="module")
def system():
    with escape_hw.open_system("revolt-shwfs", seed=3, set=FEW) as opened:
        yield opened


@pytest.fixture(scope="module")
def found(system):
    return system.calibrate("escape", frames=500)


@pytest.mark.slow
def test_the_lenslets_are_those_of_the_public_configuration(system, found):
    assert found.grid.n_valid == 188
    assert np.array_equal(found.grid.valid, system.config.sensor.valid_map())
    assert system.dm.info.n_act == 277
    injected, estimate = system.config.twin.registration.to_registration(), found.registration
    for name, one in estimate.parameters().items():
        assert abs(one.value - getattr(injected, name)) < 5 * one.sigma


@pytest.mark.parametrize("frames", CONTROLLERS)
@pytest.mark.slow
def test_the_delay_of_each_controller_is_found(frames):
    changes = [*FEW, f"twin.latency_s={CONTROLLERS[frames]}"]
    with escape_hw.open_system("revolt-shwfs", seed=4, set=changes) as system:
        response = system.calibrate("docrime", frames=300).response
    assert np.argmax(response.weights) == frames
    assert response.delay_frames == pytest.approx(frames, abs=0.4)


@pytest.mark.slow
def test_the_loop_closes_on_the_star(system, found):
    model = system.take_model_psf()
    run = system.close_loop(found, frames=300, model_psf=model, gain=0.4)
    still = system.close_loop(found, frames=300, model_psf=model, gain=1e-4)
    assert run.stable
    assert run.strehl.peak.value > 1.5 * still.strehl.peak.value
