"""The static focus, separated from that of the turbulence, on screens moved by wind."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.sensor import SubApertureGrid
from escape_hw.calibration.acquisition.slope_statistics import SlopeStatistics, StaticFocusEstimator
from escape_sim.atmosphere.phase_plates import von_karman_screen

N_SUB, RATE_HZ, SIZE = 16, 500.0, 1024
#: Pupils per second of the wind, and pixels of the screen per sub-aperture.
WIND, PIXELS = 2.0, 2
STILL = 0.02


def grid() -> SubApertureGrid:
    line = np.arange(N_SUB) - (N_SUB - 1) / 2
    r2 = line[:, None] ** 2 + line**2
    valid = r2 <= (N_SUB / 2) ** 2
    flux = np.exp(-2 * r2 / (0.75 * N_SUB) ** 2).astype(np.float32)
    return SubApertureGrid(10.0, (0.0, 0.0), valid, np.zeros((int(valid.sum()), 2), np.float32), flux)


def layer(seed: int, frames: int, direction: float) -> np.ndarray:
    """Slopes ``(frames, n_slopes)`` of one layer of turbulence, about half a pixel rms."""
    screen = von_karman_screen(SIZE, 1.0, 6.0, 4.0 * N_SUB * PIXELS, np.random.default_rng(seed)) * 0.2
    gradients = np.gradient(screen, axis=1), np.gradient(screen, axis=0)
    rows, columns = np.nonzero(grid().valid)
    step = WIND * N_SUB * PIXELS / RATE_HZ
    out = np.empty((frames, 2 * rows.size), np.float32)
    for t in range(frames):
        x, y = (step * t * np.array([np.cos(direction), np.sin(direction)])).tolist()
        at_x, at_y = columns * PIXELS + x + 100, rows * PIXELS + y + 100
        i, j = np.floor(at_y).astype(int), np.floor(at_x).astype(int)
        fy, fx = at_y - i, at_x - j
        for k, g in enumerate(gradients):
            here = [g[(i + a) % SIZE, (j + b) % SIZE] for a, b in ((0, 0), (0, 1), (1, 0), (1, 1))]
            top, low = here[0] + fx * (here[1] - here[0]), here[2] + fx * (here[3] - here[2])
            out[t, k * rows.size : (k + 1) * rows.size] = top + fy * (low - top)
    return out


def lattice() -> np.ndarray:
    """Slopes of a lattice whose pitch is ``STILL`` larger than was thought, shifted a little."""
    rows, columns = np.nonzero(grid().valid)
    middle = (N_SUB - 1) / 2
    return np.concatenate([STILL * (columns - middle) + 0.3, STILL * (rows - middle) - 0.2])


def watched(slopes: np.ndarray) -> tuple[StaticFocusEstimator, SlopeStatistics]:
    focus, slope_statistics = StaticFocusEstimator(grid(), RATE_HZ), SlopeStatistics(slopes.shape[1])
    for row in slopes.astype(np.float32):
        focus.add(row)
        slope_statistics.add(row)
    return focus, slope_statistics


def stretch(found: SubApertureGrid) -> float:
    """Pitch that the references of a grid add."""
    _, columns = np.nonzero(found.valid)
    return float(np.polyfit(columns, found.references_px[:, 0], 1)[0])


@pytest.fixture(scope="module")
def errors() -> np.ndarray:
    """Errors of the references' pitch with and without the wind's help, over seeds ``(2, n)``."""
    out = []
    for seed in range(8):
        noise = np.random.default_rng(seed).normal(0, 0.05, (1000, lattice().size))
        focus, slope_statistics = watched(layer(seed, 1000, direction=0.4 + seed) + lattice() + noise)
        assert focus.static_focus() is not None
        out.append([stretch(slope_statistics.update_references(grid(), f)) - STILL for f in (focus, None)])
    return np.array(out).T


def test_the_static_focus_is_recovered(errors):
    told, plain = np.sqrt(np.mean(np.square(errors), axis=1))
    assert told < plain / 3
    # Eight runs: no bias beyond three standard errors.
    assert abs(errors[0].mean()) < 3 * errors[0].std(ddof=1) / np.sqrt(8)


def test_what_the_wind_does_not_explain_is_left_as_it_was():
    two = layer(1, 1000, 0.0) + layer(2, 1000, np.pi / 2)
    focus, slope_statistics = watched(two + lattice())
    assert focus.static_focus() is None
    assert np.array_equal(
        slope_statistics.update_references(grid(), focus).references_px,
        slope_statistics.update_references(grid()).references_px,
    )


def test_a_short_run_and_weak_turbulence_do_not_determine_it():
    assert watched(layer(1, 300, 0.0) + lattice())[0].static_focus() is None
    rng = np.random.default_rng(1)
    calm, slope_statistics = watched(lattice() + rng.normal(0, 0.05, (1000, lattice().size)))
    assert calm.static_focus() is None
    assert stretch(slope_statistics.update_references(grid(), calm)) == pytest.approx(STILL, abs=1e-3)
