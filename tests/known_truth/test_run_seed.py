"""The seed of a run changes turbulence and noise, and leaves the bench unchanged."""

from __future__ import annotations

import numpy as np
import pytest
import small_pyramid
import small_system

import escape_hw
from escape_hw.api import concurrency as threads
from escape_sim.optics.pyramid import PyramidOptics


def opened(*more: str):
    return escape_hw.open_system("razor-shwfs", set=(*small_system.SMALL, *more))


def test_runs_differ_in_turbulence_and_noise_on_the_same_bench():
    seen, truths = [], []
    for more in ((), ("twin.run_seed=5",), ("twin.run_seed=5",), ("twin.run_seed=6",)):
        with opened(*more) as bench:
            twin = bench.dm.twin
            seen.append(np.stack([bench.wfs.next_frame(1.0).data for _ in range(3)]).astype(int))
            truths.append((twin.influence.gain, twin.mirror_opd(np.ones(twin.influence.n_act) * 0.1)))
    plain, first, again, other = seen
    assert np.array_equal(first, again)
    assert not np.array_equal(first, plain)
    assert not np.array_equal(first, other)
    for gain, surface in truths[1:]:
        assert np.array_equal(gain, truths[0][0])
        assert np.array_equal(surface, truths[0][1])


def test_the_cameras_pixels_belong_to_the_bench():
    dark = []
    for seed in range(2):
        with opened(f"twin.run_seed={seed}") as bench:
            bench.screen.set(blocked=True)
            dark.append(np.mean([bench.wfs.next_frame(1.0).data for _ in range(60)], axis=0))
    # A pattern of 1 count against noise of 1 / sqrt(60).
    assert np.corrcoef(dark[0].ravel(), dark[1].ravel())[0, 1] > 0.9


@pytest.mark.parametrize("threaded", [True, False])
def test_a_pyramid_without_helper_threads_makes_the_same_image(monkeypatch, threaded):
    images = []
    for helpers in (True, threaded):
        monkeypatch.setattr(threads, "_helper_threads_allowed", helpers)
        with small_pyramid.small() as bench:
            images.append(bench.wfs.next_frame(1.0).data)
            optics = bench.dm.twin.sensor()
            assert isinstance(optics, PyramidOptics)
            assert (optics._executor is not None) == helpers
    assert np.array_equal(*images)
