"""Optical gains from two matrices: the paper's ratio and its bias, the projection without one."""

from __future__ import annotations

from dataclasses import replace

import fake_results as fake
import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.calibration.acquisition.pokes import noise_gain, scale_to_strehl_budget, strehl_loss
from escape_hw.calibration.optical_gain.matrix_comparison import (
    deviation_ratio,
    projection,
    projector,
    scale_matrix,
    slope_weights,
)
from escape_hw.errors import CalibrationError

N_MODES = 12
TRUE = np.linspace(0.5, 0.8, N_MODES)


def clean() -> InteractionMatrix:
    base = fake.matrix(n_modes=N_MODES)
    return replace(base, sigma=np.zeros_like(base.sigma))


def noisy(matrix: InteractionMatrix, share: float, rng: np.random.Generator) -> InteractionMatrix:
    """With noise of ``share`` of the columns' rms, three times as large on every third slope."""
    rms = np.sqrt(np.mean(np.square(matrix.data), axis=0))
    sigma = share * rms * np.where(np.arange(matrix.n_slopes) % 3, 1.0, 3.0)[:, None]
    data = matrix.data + sigma * rng.standard_normal(matrix.data.shape)
    return replace(matrix, data=data.astype(np.float32), sigma=sigma.astype(np.float32))


def test_both_estimators_are_right_without_noise():
    reference = clean()
    measured = scale_matrix(reference, TRUE)
    for value, sigma in (deviation_ratio(measured, reference), projection(measured, reference)):
        np.testing.assert_allclose(value, TRUE, rtol=1e-5)
        assert not sigma.any()


def test_noise_biases_the_ratio_as_predicted_and_the_projection_not():
    rng, reference = np.random.default_rng(0), clean()
    ratios, fits, errors = [], [], []
    for _ in range(40):
        measured = noisy(scale_matrix(reference, TRUE), 0.5, rng)
        ratios.append(deviation_ratio(measured, reference)[0])
        value, sigma = projection(measured, reference)
        fits.append(value)
        errors.append(sigma)
    # E stdev^2 = stdev_0^2 + mean sigma^2: 0.25 of the power, times the mean of 1, 1 and 9.
    expected = TRUE * np.sqrt(1 + 0.25 * 11 / 3)
    np.testing.assert_allclose(np.mean(ratios, axis=0), expected, rtol=0.02)
    pulls = (np.array(fits) - TRUE) / np.array(errors)
    assert abs(pulls.mean()) < 4 / np.sqrt(pulls.size)
    assert 0.8 < np.mean(pulls**2) < 1.25


def test_errors_of_the_ratio_are_correct():
    rng, reference = np.random.default_rng(1), clean()
    found = [deviation_ratio(noisy(reference, 0.1, rng), reference) for _ in range(60)]
    values, sigmas = (np.array([pair[k] for pair in found]) for k in (0, 1))
    assert np.mean(sigmas) == pytest.approx(np.mean(values.std(axis=0, ddof=1)), rel=0.15)


def test_a_noisy_reference_does_not_lower_the_gain():
    rng, reference = np.random.default_rng(2), clean()
    pulls = []
    for _ in range(40):
        value, sigma = projection(noisy(scale_matrix(reference, TRUE), 0.1, rng), noisy(reference, 0.3, rng))
        pulls.append((value - TRUE) / sigma)
    # Without the correction the gains would be lower by 0.09 * 11 / 3, many standard errors.
    assert abs(np.mean(pulls)) < 0.3
    assert 0.7 < np.mean(np.square(pulls)) < 1.4


def test_weights_favour_quiet_slopes_and_cut_the_error():
    reference = clean()
    measured = noisy(reference, 0.5, np.random.default_rng(3))
    weights = slope_weights(measured)
    assert weights.mean() == pytest.approx(1)
    assert weights[1] == pytest.approx(9 * weights[0], rel=1e-3)
    assert (slope_weights(reference) == 1).all()
    flat = projector(reference, np.ones(reference.n_slopes))
    plain = np.sqrt(np.einsum("ms,sm->m", flat**2, np.square(measured.sigma, dtype=float)))
    assert (projection(measured, reference)[1] < 0.8 * plain).all()


def test_a_reference_of_noise_and_matrices_that_do_not_fit_are_refused():
    reference = clean()
    drowned = noisy(reference, 5.0, np.random.default_rng(4))
    with pytest.raises(CalibrationError, match=r"mode \d+ of the reference matrix is noise"):
        projection(reference, drowned)
    with pytest.raises(CalibrationError, match="no optical gain"):
        projection(fake.matrix(n_modes=N_MODES - 1), reference)
    with pytest.raises(CalibrationError, match="different modes"):
        deviation_ratio(replace(reference, m2c=reference.m2c[:, ::-1]), reference)
    empty = reference.data.copy()
    empty[:, 3] = 0
    with pytest.raises(CalibrationError, match="mode 3 of the reference matrix is empty"):
        deviation_ratio(reference, replace(reference, data=empty))


def test_scaling_takes_the_gains_errors_along():
    reference = clean()
    made = scale_matrix(reference, TRUE, 0.1 * TRUE)
    np.testing.assert_allclose(made.data, reference.data * TRUE, rtol=1e-6)
    np.testing.assert_allclose(made.sigma, np.abs(reference.data) * 0.1 * TRUE, rtol=1e-5)
    for wrong in (-TRUE, TRUE[1:], np.full(N_MODES, np.nan)):
        with pytest.raises(ValueError, match="12 positive optical gains"):
            scale_matrix(reference, wrong)


@pytest.mark.parametrize(("gain", "delay"), [(0.3, 2), (0.5, 2), (0.5, 1), (0.3, 3)])
def test_the_loop_raises_white_pokes_as_a_simulated_loop_does(gain, delay):
    rng, leak = np.random.default_rng(0), 0.02
    pokes, state = rng.standard_normal(100_000), 0.0
    command = np.zeros(pokes.size)
    for k in range(pokes.size):
        seen = command[k - delay] if k >= delay else 0.0
        state = (1 - leak) * state - gain * seen
        command[k] = state + pokes[k]
    assert noise_gain(gain, leak, delay) == pytest.approx(command.var(), rel=0.03)


def test_the_budget_holds_and_small_pokes_stay_as_they_are():
    amplitude = np.full(94, 0.002)
    whole = strehl_loss(amplitude, 2.2e-6, 635e-9)
    assert whole == pytest.approx(1 - np.exp(-94 / 3 * (2 * np.pi * 8.8 / 635) ** 2), rel=1e-6)
    lowered = scale_to_strehl_budget(amplitude, 0.01, 2.2e-6, 635e-9, 1.3)
    assert strehl_loss(lowered, 2.2e-6, 635e-9, 1.3) == pytest.approx(0.01)
    assert scale_to_strehl_budget(1e-3 * amplitude, 0.01, 2.2e-6, 635e-9) == pytest.approx(1e-3 * amplitude)
    assert not scale_to_strehl_budget(0 * amplitude, 0.01, 2.2e-6, 635e-9).any()
