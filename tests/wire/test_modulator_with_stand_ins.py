"""The real drivers of a pyramid bench, including the modulator's, on the simulated bench."""

from __future__ import annotations

import os
from unittest.mock import patch

import numpy as np
import pytest
from driver_bench import stand_in

from escape_hw.config.loader import load_system
from escape_hw.runtime.session.system import System
from escape_sim.devices.twins import shared_bench
from escape_sim.stand_ins.bench_server import StandInBenchServer

#: A small pyramid on increments of the real camera.
SMALL = (
    "sensor.n_sub=16",
    "sensor.pupils_px=[[11.0,12.0],[38.0,16.0],[11.0,32.0],[33.0,32.0]]",
    "devices.wfs.region=[296,232,48,48]",
    'devices.screen.sim_driver=""',
    "twin.wfs.photons_per_frame=2.0e6",
    "twin.pyramid.centre_offsets_px=[[0.0,0.0],[0.0,0.0],[0.0,0.0],[0.0,0.0]]",
    "twin.pyramid.drift=0.0",
)


def test_the_modulators_driver_turns_the_twins_beam() -> None:
    for name in ("asdk", "m3api", "aravis"):
        stand_in(name).clear(record=False)
    config = load_system("razor-pywfs", overrides=SMALL)
    with StandInBenchServer(config) as server, patch.dict(os.environ, server.environment):
        circle = shared_bench(config, server.shared).beam_path
        with System.from_config(load_system("razor-pywfs", mode="hardware", overrides=SMALL)) as bench:
            assert bench.simulated
            assert circle.points().points.tolist() == [[0.0, 0.0]]
            bench.find_sensor(frames=5)
            assert np.hypot(*circle.points().points.T) == pytest.approx(np.full(20, 3.0), rel=5e-3)
            assert circle.cycle_period_s == pytest.approx(66 * 50e-6)
        assert circle.cycle_period_s is None
        assert server.modulator is not None
        assert server.modulator.violations == ()
