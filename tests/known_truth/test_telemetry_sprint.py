"""The registration from telemetry, against injected values and the fit to the matrix."""

from __future__ import annotations

import numpy as np
import pytest
from small_system import GAUSSIAN_TWIN, configuration

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.results import CalibrationResult
from escape_hw.calibration.sprint.telemetry_fit import (
    MIN_WHITENED_FRAMES,
    WhitenedFrames,
    decorrelate_columns,
    telemetry_from_frames,
)
from escape_hw.errors import TooFewFrames
from escape_hw.paper.sky_time import GOAL, random_registration, registration_overrides
from escape_hw.runtime.session.system import System, open_system

SYSTEM = "razor-shwfs"


def _calibrate(number: int, frames: int, *more: str) -> tuple[np.ndarray, CalibrationResult]:
    """Errors of the registration on a random realisation, all imperfections on, and the calibration."""
    realisation = random_registration(number)
    with open_system(SYSTEM, set=[*registration_overrides(realisation), *more], seed=number + 1) as bench:
        result = bench.calibrate(frames=frames)
    assert result.registration is not None
    assert result.registration.converged, result.registration.warnings
    return result.registration.registration.to_array() - realisation.to_array(), result


@pytest.fixture(scope="module")
def fifty() -> list[tuple[np.ndarray, CalibrationResult]]:
    return [_calibrate(number, 50, *GAUSSIAN_TWIN) for number in range(2)]


@pytest.mark.slow
def test_a_tenth_of_a_second_meets_the_goal_on_every_realisation(fifty):
    for errors, result in fifty:
        assert (np.abs(errors) <= 2 * GOAL).all(), errors
        assert result.frames <= 50
    assert (np.sqrt(np.mean([np.square(e) for e, _ in fifty], axis=0)) <= GOAL).all()


@pytest.mark.slow
def test_its_errors_are_what_it_says(fifty):
    pulls = np.array([errors / result.registration.sigma for errors, result in fifty])
    assert np.abs(pulls).max() < 4
    assert 0.1 < np.mean(np.square(pulls)) < 3


@pytest.mark.slow
def test_it_finds_the_temporal_response(fifty):
    for _, result in fifty:
        response = result.response
        # Computer, half an exposure, read-out and settling: a little over two frames.
        assert response.delay_frames == pytest.approx(2.16, abs=0.05)
        early = np.abs(response.weights[:2]) / response.sigma[:2]
        assert (early < 5).all()


@pytest.mark.slow
def test_the_matrix_is_synthetic_and_there_is_no_measured_one(fifty):
    _, result = fifty[0]
    assert result.measured is None
    assert result.matrix.method == "escape"
    assert result.matrix.metrics["frames"] == result.frames
    assert any("telemetry" in note for note in result.notes)


def test_matrix_and_telemetry_agree_on_the_same_frames():
    found = []
    for estimator in ("matrix", "telemetry"):
        with System.from_config(configuration(seed=3)) as bench:
            found.append(bench.calibrate(frames=700, estimator=estimator))
    matrix, telemetry = found
    a, b = matrix.registration, telemetry.registration
    difference = a.registration.to_array() - b.registration.to_array()
    # The same frames: they differ by less than either may be wrong.
    assert (np.abs(difference) < 2.5 * np.maximum(a.sigma, b.sigma)).all()
    np.testing.assert_array_equal(matrix.measured.data, telemetry.measured.data)


def test_turned_columns_hold_the_likelihood():
    """Residual of the turned matrix = residual of the frames, up to what no matrix explains."""
    rng = np.random.default_rng(3)
    n_slopes, n_modes, n = 14, 9, 6
    seen, truth = rng.standard_normal((n, n_modes)), rng.standard_normal((n_slopes, n_modes))
    slopes = seen @ truth.T + 0.1 * rng.standard_normal((n, n_slopes))
    gram = seen.T @ seen
    valid = np.ones((1, n_slopes // 2), bool)
    measured = InteractionMatrix(
        (slopes.T @ seen @ np.linalg.pinv(gram)).astype(np.float32),
        np.ones((n_slopes, n_modes), np.float32), np.eye(n_modes), valid, "x", "y", True,
    )  # fmt: skip
    turned = decorrelate_columns(measured, gram, np.full(n_slopes, 0.01))
    assert turned.data.shape == (n_slopes, n)
    for _ in range(3):
        trial = rng.standard_normal((n_slopes, n_modes))
        by_frames = np.square(slopes - seen @ trial.T).sum()
        by_columns = np.square(turned.data - trial @ turned.m2c).sum()
        # Fewer frames than modes: the turned matrix reproduces every frame, so nothing is left over.
        assert by_columns == pytest.approx(by_frames, rel=1e-4)
    np.testing.assert_allclose(turned.sigma, 0.1, rtol=1e-6)


def test_the_noise_is_known_without_a_model_from_more_frames_than_modes():
    """The variance about a least-squares matrix is that of the noise, whatever the matrix."""
    rng = np.random.default_rng(4)
    n_slopes, n_modes, n = 40, 9, 60
    pokes, deviation = rng.standard_normal((n, n_modes)), rng.uniform(0.5, 2.0, n_slopes)
    slopes = 5 * pokes @ rng.standard_normal((n_modes, n_slopes)) + deviation * rng.standard_normal(
        (n, n_slopes)
    )
    slopes, pokes = slopes - slopes.mean(axis=0), pokes - pokes.mean(axis=0)

    def noise(first: int, closed: bool = False):
        commands = pokes[None, :first]
        frames = WhitenedFrames(slopes[:first], commands, commands.copy() if closed else commands)
        return frames.pure_error(np.ones(1))

    assert np.mean(noise(n) / deviation**2) == pytest.approx(1.0, abs=0.08)
    assert noise(n, closed=True) is None
    assert noise(n_modes + MIN_WHITENED_FRAMES) is None


def test_lost_frames_keep_the_last_poke_and_lose_no_other():
    index = np.array([5, 6, 9, 10])
    slopes, pokes = np.arange(8.0).reshape(4, 2), np.arange(12.0).reshape(4, 3) + 1
    data = telemetry_from_frames(index, slopes, pokes, before=2)
    assert data.present.tolist() == [False, False, True, True, False, False, True, True]
    np.testing.assert_array_equal(data.pokes[:2], 0)
    np.testing.assert_array_equal(data.pokes[2:], pokes[[0, 1, 1, 1, 2, 3]])
    np.testing.assert_array_equal(data.slopes[data.present], slopes)


def test_too_few_frames_are_refused_before_anything_moves():
    with open_system(SYSTEM) as bench:
        sent = bench.dm.sent_count
        with pytest.raises(TooFewFrames, match="at least 13 frames"):
            bench.calibrate(frames=10)
        assert bench.dm.sent_count == sent


def test_frames_from_a_bench_that_does_not_move_give_no_registration():
    with System.from_config(configuration("devices.dm.stroke_m=1e-12")) as bench:
        still = _attempt(bench)
    assert still is None or not still.converged


def _attempt(bench: System):
    from escape_hw.errors import CalibrationError

    try:
        return bench.calibrate(frames=60).registration
    except CalibrationError:
        return None
