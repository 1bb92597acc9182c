"""Rules that detect a diverging loop: conditions that open it and conditions that do not."""

from __future__ import annotations

from array import array

import numpy as np
import pytest
from small_system import configuration

from escape_hw.calibration.loop.divergence import (
    BlockResidualMonitor,
    ResidualMonitor,
    SaturationMonitor,
    is_above_stable,
    is_steady,
)
from escape_hw.config.system import ServerSection

RATE_HZ = 500.0


def settings(*overrides: str) -> ServerSection:
    return configuration(*overrides).server


def frames_until_opened(monitor: ResidualMonitor, residual: np.ndarray, block: int = 50) -> int | None:
    for start in range(0, residual.size, block):
        if monitor(array("f", residual[start : start + block].tolist())):
            return start + block
    return None


def converging(frames: int, level: float = 50.0) -> np.ndarray:
    noise = np.random.default_rng(1).normal(0, 0.1 * level, frames)
    return level + noise + 500 * np.exp(-np.arange(frames) / 10)


@pytest.mark.parametrize("seconds", [0.4, 1.0])
def test_a_residual_that_stays_too_large_opens_the_loop_after_the_time_configured(seconds):
    residual = np.concatenate([converging(2000), np.full(2000, 700.0)])
    monitor = ResidualMonitor(settings(f"server.diverging_s={seconds}"), RATE_HZ)
    opened = frames_until_opened(monitor, residual)
    assert opened is not None
    assert 2000 + seconds * RATE_HZ <= opened <= 2000 + seconds * RATE_HZ + 150
    assert monitor.growth > 4


@pytest.mark.parametrize(
    "residual",
    [
        converging(4000),
        np.concatenate([converging(2000), np.full(200, 700.0), converging(2000)[500:]]),
        np.concatenate([converging(2000), np.full(2000, 150.0)]),
        np.concatenate([converging(2000), np.full(2000, 480.0)]),
    ],
    ids=["converges", "a gust", "below the factor", "below the residual at closing"],
)
def test_these_leave_it_closed(residual):
    assert frames_until_opened(ResidualMonitor(settings(), RATE_HZ), residual) is None


def test_a_residual_that_is_not_finite_opens_it_at_once():
    residual = converging(300)
    residual[120:] = np.nan
    assert frames_until_opened(ResidualMonitor(settings(), RATE_HZ), residual) == 150


def test_saturation_must_last():
    is_saturated = SaturationMonitor(settings(), 100)
    assert not any(is_saturated(21) for _ in range(49))
    assert not is_saturated(20)
    assert not any(is_saturated(100) for _ in range(49))
    assert is_saturated(21)


def test_a_loop_with_pokes_is_compared_with_its_last_blocks():
    monitor = BlockResidualMonitor(settings())

    def block(level: float, shortened: int = 0) -> bool:
        return monitor([level] * 100, shortened)

    assert not any(block(level) for level in (1000.0, 50.0, 50.0, 150.0))
    assert not block(120.0, shortened=80)
    assert block(260.0, shortened=95)
    assert block(500.0)


def test_a_run_is_steady_unless_it_doubles_at_its_end():
    residual = converging(3000).astype(np.float32)
    assert is_steady(residual)
    residual[2000:] *= 2.2
    assert not is_steady(residual)
    assert not is_steady(np.array([1.0, np.nan], np.float32))


def test_a_segment_is_compared_with_the_stable_ones():
    assert is_above_stable(160.0, [100.0, 90.0, np.nan])
    assert not is_above_stable(140.0, [100.0, 90.0])
    assert not is_above_stable(140.0, []), "nothing to compare with"
