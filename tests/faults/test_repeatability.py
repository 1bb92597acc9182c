"""The same seed gives identical results; the twin has a simulated clock, or real time when paced."""

from __future__ import annotations

import time

import numpy as np
import pytest
from small_bench import small

from escape_hw.calibration.acquisition.model_psf import measure_model_psf
from escape_hw.calibration.escape.method import escape
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.calibration.push_pull.procedure import push_pull


def everything(seed: int):
    """A push-pull, an ESCAPE calibration and a loop: every device and every random stream takes part."""
    with small(seed=seed) as bench:
        bench.screen.set(inserted=False)
        baseline = bench.run(push_pull(bench, frames=3))
        bench.screen.set(inserted=True)
        found = bench.run(escape(bench, frames=300))
        psf = bench.run(measure_model_psf(bench, frames=3))
        loop = bench.run(close_loop(bench, found.matrix, found.grid, frames=250, model_psf=psf))
        return baseline, found, loop, bench.wfs.now_ns()


def numbers(result) -> dict[str, np.ndarray]:
    baseline, found, loop, clock = result
    return {
        "push-pull": baseline.matrix.data,
        "push-pull errors": baseline.matrix.sigma,
        "measured": found.measured.data,
        "measured errors": found.measured.sigma,
        "escape": found.matrix.data,
        "registration": found.registration.registration.to_array(),
        "covariance": found.registration.covariance,
        "residual": loop.residual_nm,
        "last command": loop.last_command,
        "last frame": loop.last_frame,
        "psf": loop.psf,
        "mean frame": found.mean_frame,
        "lost": np.array([found.lost_frames, loop.lost_frames]),
        "clock": np.array(clock),
    }


def test_the_same_seed_gives_the_same_bits_and_another_does_not():
    first, second, other = (numbers(everything(seed)) for seed in (7, 7, 8))
    for name, value in first.items():
        np.testing.assert_array_equal(value, second[name], err_msg=name)
    for name in ("push-pull", "measured", "registration", "residual", "last frame", "psf"):
        assert first[name].shape != other[name].shape or not np.array_equal(first[name], other[name]), name


def test_the_clock_does_not_depend_on_how_long_anything_takes(good):
    """A slow computer gets the same frames: time passes only when the twin's devices are waited for."""
    found = []
    for pause in (0.0, 0.002):
        with small() as bench:
            frames = []
            for _ in range(20):
                frames.append(bench.wfs.next_frame())
                time.sleep(pause)
            found.append(frames)
    for quick, slow in zip(*found, strict=True):
        assert (quick.index, quick.arrived_ns) == (slow.index, slow.arrived_ns)
        np.testing.assert_array_equal(quick.data, slow.data)


@pytest.mark.parametrize("delay", [0.0, 0.4])
def test_a_paced_twin_takes_real_time(delay):
    with small("twin.paced=true", "twin.loss_probability=0") as bench:
        bench.wfs.next_frame()
        time.sleep(delay)
        bench.wfs.next_frame()
        started, from_ns = time.monotonic(), bench.wfs.now_ns()
        for _ in range(200):
            bench.wfs.next_frame()
        wall, simulated = time.monotonic() - started, (bench.wfs.now_ns() - from_ns) * 1e-9
    assert simulated == pytest.approx(0.4, abs=0.01)
    # Never ahead of the wall clock, whatever it was doing before; behind only where the machine is slow.
    assert wall > simulated - 0.06
    assert wall < simulated + 1.5


def test_an_unpaced_twin_does_not_wait():
    with small("devices.wfs.frame_rate_hz=10", "twin.loss_probability=0") as bench:
        bench.wfs.next_frame()
        started = time.monotonic()
        for _ in range(50):
            bench.wfs.next_frame()
        assert bench.wfs.now_ns() > 5e9
        assert time.monotonic() - started < 2.5
