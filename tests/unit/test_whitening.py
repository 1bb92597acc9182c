"""The whitening filter: prediction from the past, also with missing frames."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import lfilter

from escape_hw.calibration.docrime.whitening import (
    apply_filter,
    apply_history_filters,
    count_known_history,
    fit_history_filters,
    fit_prediction_error_filter,
)

PROCESSES = {
    "AR(1)": [0.95],
    "AR(2), smooth": [1.9, -0.93],
    "AR(3)": [0.5, -0.3, 0.2],
    "white": [0.0],
}


def process(coefficients, n=4000, n_slopes=20, seed=0, noise=0.0):
    rng = np.random.default_rng(seed)
    kicks = rng.standard_normal((n + 500, n_slopes)) * np.geomspace(0.3, 3, n_slopes)
    out = lfilter([1.0], [1.0, *(-np.asarray(coefficients))], kicks, axis=0)[500:]
    # Every slope has its own mean, which is nobody's turbulence.
    out += np.linspace(-5, 5, n_slopes) + noise * rng.standard_normal(out.shape)
    return out.astype(np.float32)


@pytest.mark.parametrize("name", PROCESSES)
def test_an_autoregressive_process_is_recovered(name):
    coefficients = PROCESSES[name]
    x = process(coefficients)
    filter_ = fit_prediction_error_filter(x, np.ones(len(x), bool), 4)
    want = np.concatenate([[1.0], -np.asarray(coefficients), np.zeros(4 - len(coefficients))])
    # Each coefficient's error is about 1 / sqrt(frames x slopes), a few times more where they compete.
    assert filter_ == pytest.approx(want, abs=0.03)


@pytest.mark.parametrize("name", PROCESSES)
def test_what_is_left_is_white(name):
    x = process(PROCESSES[name])
    filter_ = fit_prediction_error_filter(x, np.ones(len(x), bool), 4)
    e = apply_filter(x, filter_, np.arange(4, len(x)))
    e = e - e.mean(axis=0)
    e /= e.std(axis=0)
    for lag in range(1, 6):
        assert abs(np.mean(e[lag:] * e[:-lag])) < 5 / np.sqrt(e[lag:].size)


@pytest.mark.parametrize("lost", [0.01, 0.1])
def test_lost_frames_do_not_spoil_the_filter(lost):
    x = process(PROCESSES["AR(2), smooth"])
    present = np.random.default_rng(1).random(len(x)) > lost
    whole = fit_prediction_error_filter(x, np.ones(len(x), bool), 4)
    broken = x.copy()
    # Whatever stands in the rows of lost frames.
    broken[~present] = 1e6
    assert fit_prediction_error_filter(broken, present, 4) == pytest.approx(whole, abs=0.05)


def test_noise_needs_a_longer_memory():
    # Sensor noise hides the last frame's turbulence; older frames then help.
    x = process(PROCESSES["AR(1)"], noise=3.0)
    left = []
    for order in (1, 2, 4, 8):
        filter_ = fit_prediction_error_filter(x, np.ones(len(x), bool), order)
        left.append(float(apply_filter(x, filter_, np.arange(8, len(x))).var(axis=0).sum()))
    assert (np.diff(left) < 0).all()
    assert left[0] < float(x.var(axis=0).sum())


@pytest.mark.parametrize("order", [1, 3])
def test_without_signal_nothing_is_filtered(order):
    still = np.full((50, 4), 3.0, np.float32)
    filter_ = fit_prediction_error_filter(still, np.ones(50, bool), order)
    assert filter_.tolist() == [1.0] + [0.0] * order
    # No row with a complete past.
    alternate = np.arange(50) % 2 == 0
    assert fit_prediction_error_filter(process([0.5], 50), alternate, order)[0] == 1
    assert fit_prediction_error_filter(process([0.5], 2), np.ones(2, bool), order).size == order + 1


def test_order_zero_is_no_filter():
    assert fit_prediction_error_filter(process([0.9], 100), np.ones(100, bool), 0).tolist() == [1.0]


def test_noise_free_slopes_are_predicted_without_overflow():
    t = np.arange(500)
    x = np.sin(0.01 * t)[:, None] * np.linspace(1, 2, 6)
    filter_ = fit_prediction_error_filter(x.astype(np.float32), np.ones(500, bool), 6)
    assert np.isfinite(filter_).all()
    assert np.abs(apply_filter(x, filter_, np.arange(6, 500))).max() < 0.02


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_applying_a_filter_is_a_convolution(dtype):
    rng = np.random.default_rng(2)
    x, w = rng.standard_normal((40, 7)).astype(dtype), np.array([1.0, -0.7, 0.0, 0.2])
    at = np.array([3, 4, 5, 9, 20, 21, 39])
    want = sum(w[k] * x[at - k] for k in range(4))
    got = apply_filter(x, w, at)
    assert got.dtype == np.float32
    assert got == pytest.approx(want, abs=1e-5)
    assert apply_filter(x, w, np.empty(0, np.intp)).shape == (0, 7)
    assert apply_filter(x, w, at, 3) == pytest.approx(want[:, 3:], abs=1e-5)
    assert apply_filter(x, w, np.empty(0, np.intp), 3).shape == (0, 4)
    assert apply_filter(np.asfortranarray(x), w, at) == pytest.approx(want, abs=1e-5)


def test_the_past_of_a_frame_ends_where_one_was_lost():
    present = np.array([0, 1, 1, 1, 0, 1, 1, 1, 1, 1], bool)
    assert count_known_history(present, 3).tolist() == [-1, 0, 1, 2, -1, 0, 1, 2, 3, 3]
    assert count_known_history(np.ones(4, bool), 2).tolist() == [0, 1, 2, 2]


def test_frames_with_a_short_past_are_whitened_as_well_and_weighted():
    rng = np.random.default_rng(8)
    n, copies = 40, 4000
    noise = rng.standard_normal((n + 300, copies))
    slow = np.zeros_like(noise)
    for t in range(2, len(noise)):
        slow[t] = 1.5 * slow[t - 1] - 0.56 * slow[t - 2] + noise[t]
    rows, present = slow[300:], np.ones(n, bool)
    present[20] = False
    filters = fit_history_filters(rows.astype(np.float32), present, 2)
    np.testing.assert_allclose(filters[2], [1, -1.5, 0.56], atol=0.02)
    white = apply_history_filters(rows, filters, count_known_history(present, 2))
    # All but the first frame and those lost or first after the loss.
    assert white.shape == (n - 3, copies)
    covariance = white @ white.T / copies
    np.testing.assert_allclose(np.diag(covariance), 1.0, rtol=0.15)
    assert np.abs(covariance - np.diag(np.diag(covariance))).max() < 0.2


def test_without_prediction_every_frame_stays_as_it_is():
    rows = np.arange(12.0).reshape(6, 2)
    past = count_known_history(np.array([1, 1, 0, 1, 1, 1], bool), 0)
    np.testing.assert_array_equal(apply_history_filters(rows, [np.ones(1)], past), rows[[0, 1, 3, 4, 5]])
