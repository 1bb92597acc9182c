"""Stated errors of Strehl ratios against their scatter over intervals of a closed loop on the twin."""

from __future__ import annotations

import math

import numpy as np
import pytest
from small_system import SMALL

import escape_hw
from escape_hw.calibration.loop import performance as closed_loop
from escape_hw.pipeline.psf.strehl import strehl

#: Science frames of a loop of 1,000 frames.
LENGTH = 85


@pytest.mark.campaign
@pytest.mark.timeout(1800)
def test_errors_of_short_loops_are_their_scatter(monkeypatch):
    scatter, stated = [], []
    for seed in (1, 2, 3, 4):
        taken = []

        def keep(frames, model, taken=taken):
            taken[:] = [frames, model]
            return strehl(frames, model)

        monkeypatch.setattr(closed_loop, "strehl", keep)
        with escape_hw.open_system("razor-shwfs", set=SMALL, seed=seed) as bench:
            found = bench.calibrate("push-pull")
            psf = bench.take_model_psf()
            bench.close_loop(found.matrix, found.grid, gain=0.5, frames=10 * 1000, model_psf=psf)
        frames, model = taken
        parts = [strehl(frames[k : k + LENGTH], model) for k in range(0, len(frames) - LENGTH + 1, LENGTH)]
        scatter.append(np.var([part.peak.value for part in parts], ddof=1))
        stated.append(np.mean([part.peak.sigma**2 for part in parts]))
    # 4 x 10 degrees of freedom know the scatter to 11 %; two and a half of that, and what a series of this
    # length cannot tell about itself.
    assert 0.72 < math.sqrt(np.mean(stated) / np.mean(scatter)) < 1.5
