"""The turbulence of the twin, estimated from its slopes in open and in closed loop."""

from __future__ import annotations

import numpy as np
import pytest
from small_system import GAUSSIAN_TWIN, configuration

from escape_hw.api.callbacks import Callbacks
from escape_hw.api.procedure import run
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function
from escape_hw.calibration.loop.control import invert_matrix
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.runtime.session.system import System
from escape_hw.server.frontend.performance_sampler import SeeingEstimator
from escape_hw.streams.ring import Sample

FRAMES = 3000


@pytest.mark.parametrize("screen", [2, 1])
@pytest.mark.slow
def test_the_strength_of_the_turbulence_is_that_of_the_screen(screen: int):
    # Commands are converted to surfaces by the nominal mirror; with the one drawn from this seed on a mirror
    # like a DM97 the weaker turbulence is found as 7.0 (true: 9.6).
    config = configuration(f"devices.screen.screen={screen}", *GAUSSIAN_TWIN, seed=3)
    truth = config.system.pupil_m / config.devices.screen.screens_r0_m[screen]
    slopes: list[Sample] = []
    commands: list[Sample] = []
    with System.from_config(config) as bench:
        calibration = bench.calibrate("docrime", frames=1500)
        matrix, unit = calibration.matrix, 4 * np.pi * bench.dm.info.stroke_m / config.system.wavelength_m
        estimators = [
            SeeingEstimator(
                invert_matrix(matrix, dropped), matrix.m2c, calibration.response.delay_frames, unit
            )
            for dropped in (0, 4)
        ]
        slopes_of = build_slope_function(bench, calibration.grid)
        for k in range(FRAMES // 3):
            frame = bench.wfs.next_frame(1.0)
            if k % 5 == 0:
                estimators[0].add_open([Sample(k, 0, 0, slopes_of(frame.data).copy(), {})])

        def keep(kept: list[Sample], index: int, data: np.ndarray) -> None:
            kept.append(Sample(index, 0, len(slopes) + len(commands), data.copy(), {}))

        bench.callbacks = Callbacks(
            slopes=lambda index, data: keep(slopes, index, data),
            command=lambda data: keep(commands, len(commands), data),
        )
        run(close_loop(bench, matrix, calibration.grid, frames=FRAMES))
    for first in range(500, FRAMES - 20, 12):
        part = slopes[first : first + 6]
        sent = [one for one in commands if part[0].arrived_ns < one.arrived_ns < part[-1].arrived_ns]
        estimators[1].add_closed(part, sent)
    found = [estimator.strength() for estimator in estimators]
    print(f"D / r0 {truth:.1f}, open loop {found[0]:.1f}, closed loop {found[1]:.1f}")
    assert found[1] == pytest.approx(truth, rel=0.25)
    assert found[0] == pytest.approx(truth, rel=0.25)
