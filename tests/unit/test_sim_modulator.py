"""The modulator's twin: rounding of the frequency, a slow start, and an imperfect circle."""

from __future__ import annotations

import math

import numpy as np
import pytest

from escape_hw.api.modulator import Modulation
from escape_hw.config.loader import load_system
from escape_hw.config.registry import DeviceContext
from escape_hw.errors import ConfigError, SettingRejected
from escape_sim.devices.twins import make_modulator
from escape_sim.optics.modulation import BeamPath

RADIUS = 3 * 4.7e-5


def circle(*overrides: str) -> BeamPath:
    config = load_system("razor-pywfs", overrides=overrides)
    made = BeamPath(config, np.array([0.3, 1.1]))
    made.modulation = Modulation(RADIUS, 303.03)
    return made


def test_a_cycle_is_a_whole_number_of_servo_steps() -> None:
    stage = make_modulator(None, DeviceContext("stage", load_system("razor-pywfs")))
    with stage:
        for asked, steps in ((303.03, 66), (300.0, 67), (500.0, 40), (0.5, 40_000)):
            assert stage.check(Modulation(RADIUS, asked)).frequency_hz == pytest.approx(1 / (steps * 50e-6))
        for asked in (2000.0, 1e-3):
            with pytest.raises(SettingRejected, match=r"must lie in 0\.076\.\.1000 Hz"):
                stage.check(Modulation(RADIUS, asked))


def test_starting_takes_time_and_the_commanded_modulation_is_reported() -> None:
    with make_modulator(None, DeviceContext("stage", load_system("razor-pywfs"))) as stage:
        before = stage.now_ns()
        reached = stage.modulate(Modulation(RADIUS, 303.03, (1e-5, 0.0)))
        assert stage.now_ns() - before == pytest.approx(0.2e9)
        assert reached == stage.modulation
        assert (reached.radius_rad, reached.centre_rad) == (RADIUS, (1e-5, 0.0))
        stage.park()
        assert stage.modulation is None


def test_a_system_without_a_modulator_has_no_twin_of_one() -> None:
    with pytest.raises(ConfigError, match=r"no \[devices.modulator\] section"):
        make_modulator(None, DeviceContext("stage", load_system("razor-shwfs")))


def test_circle_is_the_requested_one_when_nothing_is_wrong() -> None:
    ideal = circle("twin.pyramid.ellipse=0", "twin.pyramid.phase=0", "twin.pyramid.drift=0")
    points = ideal.points()
    assert len(points.points) == 20
    assert np.hypot(*points.points.T) == pytest.approx(3.0)
    assert np.abs(points.points.mean(axis=0)).max() < 1e-12
    assert not ideal.drift(100.0).any()
    assert ideal.cycle_period_s == pytest.approx(3.3e-3, rel=1e-5)


def test_circle_is_an_ellipse_with_a_lag_about_the_commanded_centre() -> None:
    made = circle("twin.pyramid.ellipse=0.1", "twin.pyramid.phase=10")
    assert made.modulation is not None
    made.modulation = Modulation(RADIUS, 303.03, (4.7e-5, -9.4e-5))
    points = made.points().points - [1.0, -2.0]
    x, y = points.T
    assert math.sqrt(2 * np.mean(x**2)) == pytest.approx(3.0 * 1.05)
    assert math.sqrt(2 * np.mean(y**2)) == pytest.approx(3.0 * 0.95)
    assert np.mean(x * y) / math.sqrt(np.mean(x**2) * np.mean(y**2)) == pytest.approx(
        math.sin(math.radians(10))
    )


def test_centre_drifts_slowly_by_its_amplitude() -> None:
    made = circle("twin.pyramid.drift=0.05", "twin.pyramid.drift_time_s=600")
    track = np.array([made.drift(t) for t in np.linspace(0, 600, 601)])
    assert np.abs(track).max(axis=0) == pytest.approx([0.05, 0.05], rel=1e-3)
    assert np.abs(np.diff(track, axis=0)).max() < 6e-4


def test_a_parked_stage_leaves_one_point_in_the_middle() -> None:
    parked = circle()
    parked.modulation = None
    assert parked.cycle_period_s is None
    assert parked.points().points.tolist() == [[0.0, 0.0]]
