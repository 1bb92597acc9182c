"""Live data of procedures: the matrix during acquisition, SPRINT's iterations, gains, the track."""

from __future__ import annotations

import numpy as np
import pytest
from small_bench import small

from escape_hw.api.registration import TO_STREAM_UNITS
from escape_hw.api.tracking import DRIFT
from escape_hw.calibration.acquisition import preview
from escape_hw.calibration.acquisition.preview import MatrixPreview
from escape_hw.calibration.docrime.closed_loop import docrime_closed_loop
from escape_hw.calibration.docrime.open_loop import docrime_run
from escape_hw.calibration.escape.short_runs import calibrate_short_run
from escape_hw.calibration.optical_gain.bootstrap import bootstrap_gains
from escape_hw.calibration.push_pull.modulation import modulation_demodulation
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.calibration.sprint.fit import estimate_registration
from escape_hw.calibration.tracking.tracker import track
from escape_hw.runtime.session.record import without_turbulence

QUIET = "twin.loss_probability=0"


@pytest.fixture
def often(monkeypatch):
    """Pictures as often as the procedures offer them."""
    monkeypatch.setattr(preview, "PERIOD_S", 0.0)
    monkeypatch.setattr(preview, "MAX_TIME_FRACTION", 1.0)


def watched(bench, procedure):
    """Run a procedure; its result and the pictures by name."""
    shown = {}

    def watch(progress):
        shown.setdefault("metrics", []).append(progress.metrics)
        for name, array in progress.arrays.items():
            assert array.dtype == np.float32, name
            shown.setdefault(name, []).append(array.copy())

    return bench.run(procedure, observers=(watch,)), shown


@pytest.mark.slow
def test_open_loop_matrix_fills_in_and_costs_the_run_nothing(often):
    with small(QUIET) as bench:
        unwatched = bench.run(docrime_run(bench, frames=3000)).result
    with small(QUIET) as bench:
        run, shown = watched(bench, docrime_run(bench, frames=3000))
    matrix = run.result.matrix
    assert len(shown["matrix"]) >= 3
    assert np.array_equal(shown["valid"][0], matrix.valid)
    last, sigma = shown["matrix"][-1], shown["matrix_sigma"][-1]
    assert last.shape == sigma.shape == matrix.data.shape
    # Errors shrink as frames come in, and the last picture is the result but for its last block.
    assert np.median(sigma) < np.median(shown["matrix_sigma"][0])
    assert np.sqrt(np.mean(((last - matrix.data) / sigma) ** 2)) < 1.0
    # A little above 1 at most: the frames' spread counts alike in both.
    np.testing.assert_allclose(np.median(sigma / matrix.sigma), 1.0, atol=0.3)
    np.testing.assert_array_equal(matrix.data, unwatched.matrix.data)
    np.testing.assert_array_equal(matrix.sigma, unwatched.matrix.sigma)


@pytest.mark.slow
def test_closed_loop_matrix_fills_in(bench, good, often):
    result, shown = watched(bench, docrime_closed_loop(bench, good.run.result, frames=3000, poke=0.01))
    last, sigma = shown["matrix"][-1], shown["matrix_sigma"][-1]
    assert last.shape == result.matrix.data.shape
    assert np.sqrt(np.mean(((last - result.matrix.data) / sigma) ** 2)) < 1.0
    assert shown["residual"][-1].shape == (500,)
    assert (shown["residual"][-1] > 0).all()


@pytest.mark.parametrize("procedure", [push_pull, modulation_demodulation])
def test_modes_not_measured_yet_are_nan(bench, often, procedure):
    frames = {"frames": 3} if procedure is push_pull else {"frames": 40}
    with without_turbulence(bench):
        result, shown = watched(bench, procedure(bench, **frames))
    known = [int(np.isfinite(picture).all(axis=0).sum()) for picture in shown["matrix"]]
    assert known == sorted(known)
    assert 0 < known[0] < known[-1] == result.matrix.n_modes
    first = shown["matrix"][0]
    assert first.shape == result.matrix.data.shape
    assert np.isnan(first[:, known[0] :]).all()
    np.testing.assert_allclose(shown["matrix"][-1], result.matrix.data, rtol=1e-5)
    np.testing.assert_allclose(shown["matrix_sigma"][-1], result.matrix.sigma, rtol=1e-4)


@pytest.mark.parametrize("solver", ["mixed-effects", "registration-only", "batches"])
def test_sprint_shows_every_iteration(bench, good, solver):
    found, shown = watched(bench, estimate_registration(good.matrix, good.model, solver=solver))
    course = shown["registration"][-1]
    assert course.shape == (len(found.iterations), 5)
    assert shown["step_norm"][-1].shape == (len(found.iterations),)
    expected = [step.registration.to_array() * TO_STREAM_UNITS for step in found.iterations]
    np.testing.assert_allclose(course, expected, rtol=1e-6)
    np.testing.assert_allclose(shown["registration_sigma"][-1], found.sigma * TO_STREAM_UNITS, rtol=1e-6)
    if solver == "batches":  # whose answer is a mean of many iterations
        return
    # The last step was taken after it was recorded: it is below what the eye sees.
    np.testing.assert_allclose(course[-1], found.registration.to_array() * TO_STREAM_UNITS, atol=1e-3)


@pytest.mark.slow
def test_gains_show_every_round(bench, good):
    procedure = bootstrap_gains(bench, good.run.result, accuracy=0.05, frames=1200)
    run, shown = watched(bench, procedure)
    rounds = run.result.rounds
    assert len(shown["gains"]) == 1 + len(rounds)
    assert [len(picture) for picture in shown["gains_rounds"]] == list(range(1, len(rounds) + 1))
    last = rounds[-1].gains
    np.testing.assert_allclose(shown["gains"][-1], last.value, rtol=1e-6)
    np.testing.assert_allclose(shown["gains_sigma"][-1], last.sigma, rtol=1e-6)
    np.testing.assert_allclose(shown["gains_smooth"][-1], last.trend, rtol=1e-6)
    np.testing.assert_allclose(shown["gains_rounds"][-1][-1], last.best, rtol=1e-6)


@pytest.mark.slow
def test_tracking_shows_its_course():
    with small(QUIET) as bench:
        start = bench.calibrate(frames=600)
        result, shown = watched(bench, track(bench, start.matrix, start.grid, seconds=5, poke=0.002,
                                             registration=start.registration))  # fmt: skip
    lengths = [len(course) for course in shown["registration_track"]]
    assert lengths == list(range(1, len(lengths) + 1))
    assert lengths
    course = shown["registration_track"][-1]
    assert course.shape[1] == 11
    rows = len(course)
    np.testing.assert_allclose(course[:, 0], result.column("seconds")[:rows], rtol=1e-6)
    np.testing.assert_allclose(course[:, 1], result.column("shift_x")[:rows] / 100, rtol=1e-5)
    np.testing.assert_allclose(course[:, 8], np.deg2rad(result.column("rotation_sigma")[:rows]), rtol=1e-5)
    assert shown["gains"][-1].shape == (start.matrix.n_modes,)
    drift = shown["metrics"][-1][DRIFT]
    moved = np.hypot(*(course[-1, k] - course[0, k] for k in (1, 2)))
    assert 0 <= drift < 20 + 100 * moved


def test_pictures_take_a_small_share_of_the_time(monkeypatch):
    clock, spent = [0.0], []

    def slow():
        clock[0] += 0.4
        spent.append(0.4)
        return np.ones((4, 2)), np.ones((4, 2))

    monkeypatch.setattr(preview.time, "monotonic", lambda: clock[0])
    pictures = MatrixPreview(3, lambda: None)
    for _ in range(100_000):
        clock[0] += 0.001
        if pictures.is_due():
            assert pictures(slow)["matrix"].shape == (4, 3)
    assert 0.02 < sum(spent) / clock[0] < 0.05


@pytest.mark.slow
def test_a_run_too_short_for_a_matrix_has_live_maps(often):
    with small(QUIET) as bench:
        _, shown = watched(bench, calibrate_short_run(bench, frames=400))
        matrix = bench.run(docrime_run(bench, frames=3000)).result.matrix
    assert len(shown["matrix"]) >= 2
    last, sigma = shown["matrix"][-1], shown["matrix_sigma"][-1]
    assert last.shape == sigma.shape == matrix.data.shape
    assert np.corrcoef(last.ravel(), matrix.data.ravel())[0, 1] > 0.5
