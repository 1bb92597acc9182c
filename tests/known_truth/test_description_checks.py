"""What a converged fit says where the description of the system is wrong."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from small_matrices import CONFIG, GRID, MODEL, NOISE, TRUTH, measured
from small_system import SMALL, configuration

from escape_hw.calibration.sprint.description_checks import Clocking
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.config.loader import load_system
from escape_sim.models.factory import make_fast_model

Change = Callable[[NDArray[np.float32]], NDArray[np.float64]]


def stretched(data: NDArray[np.float32]) -> NDArray[np.float64]:
    """The x slopes of a camera with narrow pixels."""
    x, y = np.split(data.astype(float), 2)
    return np.concatenate([1.05 * x, y])


def clocked(data: NDArray[np.float32]) -> NDArray[np.float64]:
    """Slopes of a camera that is turned by one degree against its lenslets."""
    x, y = np.split(data.astype(float), 2)
    turn = np.deg2rad(1.0)
    return np.concatenate([np.cos(turn) * x - np.sin(turn) * y, np.sin(turn) * x + np.cos(turn) * y])


def stretched_along_a_diagonal(data: NDArray[np.float32]) -> NDArray[np.float64]:
    """Slopes of an image that is 5 % larger along a diagonal than along the other."""
    x, y = np.split(data.astype(float), 2)
    return np.concatenate([x + 0.025 * y, y + 0.025 * x])


def without_actuators(data: NDArray[np.float32]) -> NDArray[np.float64]:
    """Two actuators do not move."""
    data = data.astype(float)
    data[:, [5, 30]] = NOISE * np.random.default_rng(0).normal(size=(len(data), 2))
    return data


def with_a_dark_corner(data: NDArray[np.float32]) -> NDArray[np.float64]:
    """The first four sub-apertures have no light."""
    data, n = data.astype(float), len(data) // 2
    dark = np.r_[0:4, n : n + 4]
    data[dark] = NOISE * np.random.default_rng(0).normal(size=(8, data.shape[1]))
    return data


@pytest.mark.parametrize(
    ("change", "remark"),
    [
        (stretched, "the x slopes are"),
        (clocked, "the slopes are turned by"),
        (stretched_along_a_diagonal, "the slopes along the diagonal x = y are 5.2 % larger"),
        (without_actuators, "actuators that hardly respond: 5, 30;"),
        (with_a_dark_corner, "4 of 112 sub-apertures hardly respond, (row, column) (0, 4)"),
    ],
)
def test_it_is_named(change: Change, remark: str) -> None:
    matrix = measured(0)
    estimate = sprint(replace(matrix, data=change(matrix.data).astype(np.float32)), MODEL)
    assert any(remark in note for note in (*estimate.notes, *estimate.warnings)), estimate.notes
    # The error of the rotation includes what clocking does to it.
    assert abs(estimate.registration.rotation - TRUTH.rotation) < 3 * estimate.sigma[2]


@pytest.mark.parametrize("shear", [2.5, -2.5])
def test_a_mirror_seen_obliquely_is_no_clocked_camera(shear: float) -> None:
    true = MODEL.zonal_matrix(TRUTH.with_shear(shear))
    data = true + NOISE * np.random.default_rng(0).normal(size=true.shape)
    matrix = replace(measured(0), data=data.astype(np.float32))
    (note,) = (note for note in sprint(matrix, MODEL).notes if "the slopes" in note)
    # A mirror that is larger along a diagonal has smaller slopes along it.
    assert f"{'smaller' if shear > 0 else 'larger'} than along the other one" in note
    assert "calibration.extra_parameters = ['anamorphosis']" in note
    fitted = sprint(matrix, MODEL, extra_parameters=("anamorphosis",))
    assert not any("the slopes" in note for note in fitted.notes)
    assert fitted.extras["anamorphosis"].value == pytest.approx(shear, abs=0.15)


def test_a_correct_description_has_no_remark() -> None:
    estimate = sprint(measured(0), MODEL)
    assert not estimate.notes
    assert estimate.model_fits
    assert estimate.outcome == "converged"


def test_a_mirror_of_another_family_converges_but_does_not_fit() -> None:
    """A thin plate, described as an exponential."""
    plate = make_fast_model(configuration('devices.dm.influence="thin-plate"'), GRID)
    true = plate.zonal_matrix(TRUTH)
    data = true + NOISE * np.random.default_rng(0).normal(size=true.shape)
    estimate = sprint(replace(measured(0), data=data.astype(np.float32)), MODEL)
    assert estimate.converged, estimate.warnings
    assert estimate.model_fits is False
    assert estimate.outcome == "converged, but the model does not fit"
    assert estimate.notes[0].startswith("the model does not fit: ")


def test_a_wrong_pitch_is_named() -> None:
    across = 1.05 * CONFIG.devices.dm.pitches_across_pupil
    wrong = load_system("razor-shwfs", overrides=(*SMALL, f"devices.dm.pitches_across_pupil={across}"))
    estimate = sprint(measured(0), make_fast_model(wrong, GRID))
    assert any("larger on the sensor than described" in note for note in estimate.notes), estimate.notes


@pytest.mark.parametrize("pattern", [0.0, pytest.param(3.0, marks=pytest.mark.slow)])
def test_an_idle_mirror_is_no_wrong_layout(pattern: float) -> None:
    """Noise alone, or with one pattern of slopes, by another amount in each column, that came by itself."""
    matrix, rng = measured(0), np.random.default_rng(0)
    noise = 1.2 * NOISE * rng.normal(size=matrix.data.shape)
    drift = pattern * NOISE * np.outer(*(rng.normal(size=n) for n in matrix.data.shape))
    estimate = sprint(replace(matrix, data=(noise + drift).astype(np.float32)), MODEL)
    assert not estimate.converged
    assert "does the mirror move" in estimate.warnings[0]
    assert ("one pattern of slopes" in estimate.warnings[0]) == bool(pattern)


@pytest.mark.parametrize("true_deg", [0.0, 0.2, 0.5, 2.0])
def test_what_clocking_adds_to_the_variances_is_its_square_on_average(true_deg: float) -> None:
    """Angles known to 0.3 degrees, of a camera that turns the rotation by a fifth of its clocking."""
    rng, derivative = np.random.default_rng(8), np.array([0.0, 0.0, 0.2, 0.0, 0.0])
    angles = true_deg + 0.3 * rng.standard_normal(4000)
    added = np.mean([Clocking(a, 0.3, derivative * a).covariance[2, 2] for a in angles.tolist()])
    # Never negative, so a little more where the angle is hardly known.
    assert (0.2 * true_deg) ** 2 * 0.97 < added < (0.2 * true_deg) ** 2 * 1.03 + 0.6 * (0.2 * 0.3) ** 2
    assert not Clocking(0.0, 0.3, np.zeros(5)).covariance.any()


def test_a_clocking_that_may_be_chance_is_named_where_it_dominates_the_errors() -> None:
    clocking = Clocking(0.75, 0.3, np.array([0.0, 0.0, 0.15, 0.0, 0.0]))
    added = np.sqrt(np.diag(clocking.covariance))
    (said,) = clocking.describe(np.hypot(added, [1.0, 1.0, 0.06, 1.0, 1.0]))
    assert "may be turned by 0.75 ± 0.30 degrees" in said
    assert f"{np.hypot(added[2], 0.06) / 0.06:.1f} times" in said
    assert clocking.describe(np.hypot(added, [1.0, 1.0, 0.3, 1.0, 1.0])) == ()
    # A significant one is named whatever it does.
    (said,) = Clocking(1.0, 0.3, np.zeros(5)).describe(np.ones(5))
    assert "are turned by 1.00 ± 0.30" in said


@pytest.mark.slow
def test_y_slopes_before_x_slopes_are_named() -> None:
    matrix = measured(0)
    x, y = np.split(matrix.data, 2)
    estimate = sprint(replace(matrix, data=np.concatenate([y, x])), MODEL)
    assert not estimate.converged
    assert "order of the slopes (matrix.slopes" in estimate.warnings[0], estimate.warnings


@pytest.mark.parametrize(
    ("signs", "named"), [((-1, 1), "x"), pytest.param((1, -1), "y", marks=pytest.mark.slow)]
)
def test_slopes_of_the_other_sign_are_named(signs: tuple[int, int], named: str) -> None:
    matrix = measured(0)
    reversed_slopes = np.concatenate(
        [s * half for s, half in zip(signs, np.split(matrix.data, 2), strict=True)]
    )
    estimate = sprint(replace(matrix, data=reversed_slopes), MODEL)
    assert not estimate.converged
    assert f"(sensor.sign_{named} of" in estimate.warnings[0], estimate.warnings


def test_no_clocking_is_named_where_the_fit_did_not_converge() -> None:
    matrix = measured(0)
    estimate = sprint(replace(matrix, data=-clocked(matrix.data).astype(np.float32)), MODEL)
    assert "if the polarity were reversed" in estimate.warnings[0]
    assert not any("clocked" in note for note in estimate.notes)


@pytest.mark.parametrize(("angle", "named"), [(0.004, False), (0.006, True), (-0.004, False)])
def test_an_angle_that_is_printed_as_zero_is_not_named(angle: float, named: bool) -> None:
    assert bool(Clocking(angle, 1e-4, np.zeros(5)).describe(np.ones(5))) is named
