"""Lock-in detection of many modes at once: lines, noise, delay."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.calibration.push_pull.demodulation import (
    choose_line_frequencies,
    compute_matrix,
    estimate_delay,
    fit_lines,
    frequency_response,
)
from escape_hw.errors import TooFewFrames

FRAMES, SLOPES, MODES = 500, 30, 12


def _run(seed: int, delay: float = 2.3, noise: float = 1.0, loss: float = 0.0):
    """Slopes of a known matrix under a random walk and white noise, as a loop would record them."""
    rng = np.random.default_rng(seed)
    matrix = rng.standard_normal((SLOPES, MODES))
    amplitude = rng.uniform(0.5, 1.0, MODES)
    frequency = choose_line_frequencies(MODES, FRAMES, (0.1, 0.4))
    time = np.arange(FRAMES)
    command = amplitude * np.sin(np.outer(np.arange(-8, FRAMES), frequency))
    whole, share = int(delay), delay - int(delay)
    seen = (1 - share) * command[8 - whole :][:FRAMES] + share * command[7 - whole :][:FRAMES]
    turbulence = np.cumsum(rng.standard_normal((FRAMES, SLOPES)), axis=0)
    slopes = seen @ matrix.T + turbulence + noise * rng.standard_normal((FRAMES, SLOPES))
    kept = rng.random(FRAMES) >= loss
    return matrix, fit_lines(time[kept], slopes[kept], frequency, amplitude, FRAMES)


def test_lines_fill_the_band_and_stand_apart():
    frequency = choose_line_frequencies(MODES, FRAMES, (0.1, 0.4))
    cycles = frequency * FRAMES / (2 * np.pi)
    np.testing.assert_allclose(cycles, np.rint(cycles), atol=1e-9)
    assert (np.diff(cycles) >= 4).all()
    assert (cycles[0], cycles[-1]) == (50, 200)
    assert choose_line_frequencies(1000, FRAMES, (0.1, 0.4)).size == 38


def test_too_few_frames_for_a_line():
    with pytest.raises(TooFewFrames, match="resolve no line"):
        choose_line_frequencies(3, 12, (0.1, 0.4))
    with pytest.raises(TooFewFrames, match="too few for"):
        fit_lines(np.arange(20), np.zeros((20, 3)), np.linspace(0.7, 2, 12), np.ones(12), 20)


@pytest.mark.parametrize("loss", [0.0, 0.03])
def test_matrix_and_errors_over_seeds(loss):
    pulls, ratios = [], []
    for seed in range(25):
        matrix, lines = _run(seed, loss=loss)
        found, sigma = compute_matrix(lines, 2.3)
        pulls.append((found - matrix) / sigma)
        ratios.append(np.vdot(found, matrix) / np.vdot(matrix, matrix))
    chi2 = np.mean(np.square(pulls))
    # 9,000 elements: four standard errors of a chi-squared, and some for noise found from four bins.
    assert 0.9 < chi2 < 1.15
    assert abs(np.mean(ratios) - 1) < 4 * np.std(ratios) / 5


@pytest.mark.parametrize("delay", [0.0, 0.4, 1.0, 2.16, 3.75])
def test_delay_over_seeds(delay):
    found = np.array([estimate_delay(_run(seed, delay, noise=2.0)[1], 5.0) for seed in range(12)])
    errors = found[:, 0] - delay
    assert np.abs(errors).max() < 0.05
    assert (np.abs(errors) < 5 * found[:, 1] + 0.01).all()


def test_noise_alone_has_unit_pulls():
    rng = np.random.default_rng(4)
    frequency = choose_line_frequencies(MODES, FRAMES, (0.1, 0.4))
    lines = fit_lines(
        np.arange(FRAMES), rng.standard_normal((FRAMES, 200)), frequency, np.ones(MODES), FRAMES
    )
    found, sigma = compute_matrix(lines, 1.0)
    assert np.mean(np.square(found / sigma)) == pytest.approx(1.0, abs=0.1)


def test_response_is_a_pure_delay_for_whole_frames():
    w = np.linspace(0.1, 3, 7)
    np.testing.assert_allclose(frequency_response(w, 3.0), np.exp(-3j * w), atol=1e-12)
    assert (np.abs(frequency_response(w, 2.5)) < 1).all()
