"""Slow drift of the twins: it follows the configuration, and no model or estimator reads it."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_pyramid import configuration as pyramid

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.config.loader import load_system
from escape_hw.config.twin import TwinDrift, TwinDriftRate, TwinDriftSwing, TwinSeeing
from escape_hw.errors import ConfigError
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.session.system import System
from escape_sim.atmosphere.layers import Seeing
from escape_sim.devices.bench import SimBench
from escape_sim.mirror.surface import DriftingSurface, Flexure, make_mirror_surface

START = Registration(5.0, -7.0, 0.3, 1.0, -0.5)
DRIFT = TwinDrift(
    rate=TwinDriftRate(shift_x=0.5, rotation=-0.01, tangential_scaling=0.02),
    swing=TwinDriftSwing(shift_y=3.0, radial_scaling=0.4),
    period_s=8.0,
)
STILL = ("twin.vibration.amplitude_rad=[]", "twin.vibration.frequency_hz=[]", "devices.screen.screen=3")


def bench(*more: str) -> SimBench:
    return SimBench(load_system("razor-shwfs", overrides=more))


def test_every_parameter_follows_its_rate_and_its_sinusoid():
    flexure = Flexure(START, DRIFT)
    assert flexure.at(0.0) == START
    later = flexure.at(2.0)
    assert later.to_array() == pytest.approx([6.0, -4.0, 0.28, 1.4, -0.46])
    assert flexure.at(6.0).shift_y == pytest.approx(-10.0)


@pytest.mark.parametrize("shape", ["gaussian", "exponential"])
def test_the_surface_is_that_of_the_registration_of_the_moment(shape):
    twin = bench(f"twin.mirror.shape={shape}")
    x, sub = twin.pupil.coordinates_m, twin.pupil.sub_aperture_m
    flexure = Flexure(START, DRIFT)
    moving = DriftingSurface(twin.influence, flexure, sub, x, x)
    command = np.random.default_rng(1).uniform(-1, 1, 97)
    scale = moving(command, 0.0).std()
    for time_s in (0.0, 3.3, 7.9, 1.2):
        exact = make_mirror_surface(twin.influence, flexure.at(time_s), sub, x, x)(command)
        # What is left is little beside what 1 % of a sub-aperture does.
        nudged = Registration.from_array(flexure.at(time_s).to_array() + np.eye(5)[0])
        moved = make_mirror_surface(twin.influence, nudged, sub, x, x)(command) - exact
        assert np.abs(moving(command, time_s) - exact).std() < 0.05 * moved.std() < 0.1 * scale
    again = DriftingSurface(twin.influence, flexure, sub, x, x)
    np.testing.assert_array_equal(again(command, 1.2), moving(command, 1.2))


def test_surfaces_that_are_no_products_are_computed_once_per_per_cent(monkeypatch):
    twin, computed = bench("twin.mirror.shape=exponential", "twin.drift.rate.shift_x=0.5"), []
    make = make_mirror_surface

    def counted(*given):
        computed.append(given)
        return make(*given)

    monkeypatch.setattr("escape_sim.mirror.surface.make_mirror_surface", counted)
    for time_s in np.arange(0, 4, 0.02):
        twin.mirror_opd(np.zeros(97), time_s)
    assert len(computed) <= 3


def test_a_bench_without_drift_is_computed_once(monkeypatch):
    twin = bench()
    monkeypatch.setattr(
        "escape_sim.mirror.surface.make_mirror_surface", lambda *_: pytest.fail("derived again")
    )
    twin.optical_path(0.0, 2e-3)
    twin.optical_path(1e4, 1e4 + 2e-3)
    assert math.isinf(twin.flexure.update_interval_s)


def test_the_bench_moves_with_its_clock():
    still, moving = bench(*STILL), bench(*STILL, "twin.drift.rate.shift_x=2.0")
    command = np.zeros(97)
    command[48] = 0.3
    for one in (still, moving):
        one.plates.inserted = False
        one.dynamics.command(0.0, command)
    np.testing.assert_allclose(moving.optical_path(0.1, 0.102), still.optical_path(0.1, 0.102), atol=1e-8)
    late = moving.optical_path(50.0, 50.002)
    # A whole sub-aperture of eight samples, along columns.
    before = still.optical_path(50.0, 50.002)
    shift = twin_samples(still)
    assert np.abs(late[:, shift:] - before[:, :-shift]).max() < 0.01 * np.abs(before).max()


def twin_samples(twin: SimBench) -> int:
    return round(twin.pupil.sub_aperture_m / twin.pupil.pixel_m)


def test_seeing_scales_the_turbulence_as_kolmogorov_does():
    seeing = Seeing(TwinSeeing(rate=-0.01, swing=0.2, period_s=40.0))
    assert seeing.r0(0.0) == 1.0
    assert seeing.r0(10.0) == pytest.approx(1.1)
    assert seeing.strength(10.0) == pytest.approx(1.1 ** (-5 / 6))
    assert seeing.r0(1e4) == 0.2
    constant, changing = bench(*STILL), bench(*STILL, "twin.seeing.rate=-0.01")
    before, after = (one.optical_path(30.0, 30.002) for one in (constant, changing))
    np.testing.assert_allclose(after, before * 0.7 ** (-5 / 6), rtol=1e-4, atol=1e-12)


def test_turbulence_over_a_telescope_changes_too():
    after, before = (
        SimBench(load_system("maps-nir", overrides=(*STILL[:2], *more))).optical_path(20.0, 20.001)
        for more in (("twin.seeing.rate=-0.01",), ())
    )
    lit = np.abs(before) > 0
    ratio = np.median(after[lit] / before[lit])
    assert ratio == pytest.approx(0.8 ** (-5 / 6), rel=1e-3)


@pytest.mark.parametrize("load", [lambda *more: load_system("razor-shwfs", overrides=more), pyramid])
def test_models_do_not_use_it(load):
    words = ("twin.drift.rate.shift_x=30.0", "twin.drift.swing.rotation=5.0", "twin.seeing.rate=-0.02")
    registration = Registration(shift_x=3.0)
    with System.from_config(load()) as system:
        grid = system.find_sensor(frames=5).grid
        still = system.model(grid).zonal_matrix(registration)
        assert BenchRecord.from_bench(system).injected is not None
    with System.from_config(load(*words)) as system:
        system.wfs.next_frame(1.0)
        np.testing.assert_array_equal(system.model(grid).zonal_matrix(registration), still)
        # Nor does a report hold one number against a registration that moves.
        assert BenchRecord.from_bench(system).injected is None


def test_what_the_configuration_refuses():
    with pytest.raises(ConfigError, match=r"twin.seeing.swing"):
        load_system("razor-shwfs", overrides=["twin.seeing.swing=0.9"])
    with pytest.raises(ConfigError, match=r"period_s"):
        load_system("razor-shwfs", overrides=["twin.drift.period_s=0.0"])
    assert set(PARAMETERS) == set(TwinDriftRate.model_fields) == set(TwinDriftSwing.model_fields)
