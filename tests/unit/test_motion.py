"""Strength and correlation time of the turbulence from the slopes of a run, in the presence of pokes."""

from __future__ import annotations

import fake_results as fake
import numpy as np
import pytest

from escape_hw.api.pyramid import PyramidPupils, fit_low_orders
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics


def pupils() -> PyramidPupils:
    valid = np.ones((8, 8), bool)
    return PyramidPupils(
        np.zeros((4, 2)), 8.0, np.zeros((4, 2), np.intp), valid, np.zeros((64, 2), np.float32),
        np.ones((8, 8), np.float32),
    )  # fmt: skip


def run(
    frames: int, memory: float, white: float, seed: int, tilt: float = 0.0, tilt_memory: float = 1.0
) -> PyramidPupils:
    """Slopes with a correlation time of ``memory`` frames, a white fraction of their variance, and tilts."""
    rng = np.random.default_rng(seed)
    slope_statistics, keep = SlopeStatistics(128), np.exp(-1 / memory)
    correlated, tilts, tilt_keep = rng.standard_normal(128), rng.standard_normal(2), np.exp(-1 / tilt_memory)
    for _ in range(frames):
        correlated = keep * correlated + np.sqrt(1 - keep**2) * rng.standard_normal(128)
        tilts = tilt_keep * tilts + np.sqrt(1 - tilt_keep**2) * rng.standard_normal(2)
        slopes = np.sqrt(1 - white) * correlated + np.sqrt(white) * rng.standard_normal(128)
        slopes += tilt * np.repeat(tilts, 64)
        slope_statistics.add((0.3 * slopes + 0.1).astype(np.float32), 0.05 * rng.standard_normal(4))
    found = slope_statistics.annotate_geometry(pupils())
    assert isinstance(found, PyramidPupils)
    return found


@pytest.mark.parametrize(("memory", "white"), [(20.0, 0.0), (20.0, 0.6), (5.0, 0.3)])
def test_motion_pokes_and_what_lasts(memory: float, white: float) -> None:
    found = [run(1500, memory, white, seed) for seed in range(6)]
    assert np.mean([f.motion for f in found]) == pytest.approx(0.3, rel=0.03)
    assert np.mean([f.pokes for f in found]) == pytest.approx(0.1, rel=0.03)
    assert np.mean([f.persistent_fraction for f in found]) == pytest.approx(
        (1 - white) * np.exp(-2 / memory), abs=0.04
    )
    # The integral of an exponential's correlation is twice its memory; its fraction is estimated two frames
    # late and a little small, so its correlation seems so much longer. Noise that is new in every frame
    # does not count as states of the turbulence.
    integral = 1 + np.exp(2 / memory) * (2 / (np.exp(1 / memory) - 1))
    # The smaller of two estimates, of which that of the tilts has eight blocks of two numbers.
    assert np.mean([f.n_effective for f in found]) == pytest.approx(0.85 * 1500 / integral, rel=0.3)


@pytest.mark.parametrize(
    ("tilt_memory", "most"),
    [
        pytest.param(50.0, 22.0, marks=pytest.mark.slow),
        (300.0, 9.0),
        pytest.param(3000.0, 8.0, marks=pytest.mark.slow),
    ],
)
def test_tilts_that_outlast_the_other_slopes_count(tilt_memory: float, most: float) -> None:
    # 15, 3.1 and 1.2 independent realisations; what outlasts the run is in its mean and cannot be seen. The
    # slopes without the tilts have more than a hundred.
    assert run(1500, 5.0, 0.5, 0).n_effective > 100
    found = [run(1500, 5.0, 0.5, seed, 0.5, tilt_memory).n_effective for seed in range(12)]
    assert min(found) > 1
    assert 3 < np.median(found) < most


def test_pokes_without_turbulence_are_new_in_every_frame() -> None:
    assert run(1500, 1.0, 1.0, 2).n_effective == 1500


def test_too_few_frames_give_no_number_of_samples() -> None:
    assert run(3, 5.0, 0.0, 1).n_effective == 0
    assert run(2, 5.0, 0.0, 1).persistent_fraction == 0


def test_a_resumed_run_gives_the_same() -> None:
    rng = np.random.default_rng(7)
    slopes, pokes = rng.standard_normal((300, 128)).cumsum(axis=0), rng.standard_normal((300, 4))
    whole, first, second = (SlopeStatistics(128) for _ in range(3))
    for k in range(300):
        whole.add(slopes[k].astype(np.float32), pokes[k])
        if k == 170:
            second.restore(first.state())
        (first if k < 170 else second).add(slopes[k].astype(np.float32), pokes[k])
    one, other = whole.annotate_geometry(pupils()), second.annotate_geometry(pupils())
    assert isinstance(one, PyramidPupils)
    assert isinstance(other, PyramidPupils)
    assert (other.motion, other.pokes) == pytest.approx((one.motion, one.pokes))
    # Two pairs across the interruption are lost.
    assert other.n_effective == pytest.approx(one.n_effective, rel=0.03)
    assert other.persistent_fraction == pytest.approx(one.persistent_fraction, abs=0.02)
    seen = slopes.reshape(300, 2, 64).mean(axis=2)
    for statistics in (whole, second):
        closed = statistics.annotate_geometry(pupils(), closed=True)
        assert isinstance(closed, PyramidPupils)
        assert closed.residual_tilt == pytest.approx(np.sqrt(seen.var(axis=0).mean()), rel=1e-4)
    assert one.residual_tilt == 0
    low_orders = fit_low_orders(slopes.mean(axis=0).reshape(2, 64).T, one.valid, one.flux)
    assert one.mean_low_orders == pytest.approx(low_orders, rel=1e-4, abs=1e-4)
    assert other.mean_low_orders == pytest.approx(one.mean_low_orders)


def test_a_state_of_version_0_1_0_has_no_tilt() -> None:
    saved = SlopeStatistics(16)
    for k in range(5):
        saved.add(np.full(16, k, np.float32))
    state = saved.state()
    state[2] = state[2, 0]
    restored = SlopeStatistics(16)
    restored.restore(state)
    assert restored.state()[2, :2].tolist() == [5.0, 0.0]


def test_a_closed_loop_gives_no_turbulence_within_a_lenslet() -> None:
    rng, lenslets = np.random.default_rng(3), fake.grid(8)
    slope_statistics, slopes = SlopeStatistics(lenslets.n_slopes), np.zeros(lenslets.n_slopes)
    for _ in range(200):
        # What a loop leaves lasts for some frames as well.
        slopes = 0.8 * slopes + 0.02 * rng.standard_normal(slopes.size)
        slope_statistics.add(slopes.astype(np.float32))
    opened, closed = (
        slope_statistics.annotate_geometry(lenslets),
        slope_statistics.annotate_geometry(lenslets, closed=True),
    )
    assert 0 < opened.turbulence_px < 0.2 * lenslets.turbulence_px
    assert closed.turbulence_px == lenslets.turbulence_px
    assert closed.motion_px == opened.motion_px < lenslets.motion_px
