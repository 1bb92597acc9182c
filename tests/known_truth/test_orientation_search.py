"""The search for another orientation: names what is wrong, and nothing where the description is right."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from small_matrices import GRID, MODEL, NOISE, TRUTH, measured
from small_system import configuration

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.calibration.sprint.fit import sprint
from escape_hw.calibration.sprint.orientation import find_better_orientation
from escape_sim.models.factory import make_fast_model

COLUMNS = np.arange(37)
POLARITY = "devices.dm.polarity = -1"
TURNED = "turned by 180 degrees"


def with_data(data: NDArray[np.floating]) -> InteractionMatrix:
    return replace(measured(0), data=data.astype(np.float32))


def turned(matrix: InteractionMatrix) -> NDArray[np.floating]:
    """The matrix of a mirror whose actuators are numbered from the other end: the layout is symmetric."""
    return matrix.data[:, ::-1]


def exchanged(matrix: InteractionMatrix) -> NDArray[np.floating]:
    return np.concatenate(np.split(matrix.data, 2)[::-1])


@pytest.mark.parametrize(
    ("change", "said", "not_said"),
    [
        (lambda matrix: -matrix.data, ("if the polarity were reversed: ", POLARITY), "the sensor saw"),
        pytest.param(turned, (TURNED, "devices.dm.order = 'turn-180'"), POLARITY, marks=pytest.mark.slow),
        (lambda matrix: -turned(matrix), (TURNED, "and the polarity were reversed: ", POLARITY), "slopes"),
        pytest.param(
            lambda matrix: -exchanged(matrix),
            ("its x slopes were its y slopes and the polarity were reversed: ", POLARITY),
            "the sensor saw",
            marks=pytest.mark.slow,
        ),
    ],
    ids=["polarity", "turned", "turned, and polarity", "exchanged slopes, and polarity"],
)
def test_what_is_wrong_is_named_and_nothing_else(
    change: Callable[[InteractionMatrix], NDArray[np.floating]], said: tuple[str, ...], not_said: str
) -> None:
    estimate = sprint(with_data(change(measured(0))), MODEL)
    assert not estimate.converged
    (warning,) = estimate.warnings
    assert all(words in warning for words in said), warning
    assert not_said not in warning


def thin_plate() -> InteractionMatrix:
    true = make_fast_model(configuration('devices.dm.influence="thin-plate"'), GRID).zonal_matrix(TRUTH)
    return with_data(true + NOISE * np.random.default_rng(0).normal(size=true.shape))


def noise() -> InteractionMatrix:
    return with_data(1.2 * NOISE * np.random.default_rng(0).normal(size=measured(0).data.shape))


@pytest.mark.parametrize("errors", ["measured", "none"])
@pytest.mark.parametrize(
    "case", [lambda: measured(0), thin_plate, noise], ids=["right", "thin plate", "noise"]
)
def test_nothing_is_named_where_the_orientation_is_right_or_there_is_no_signal(
    case: Callable[[], InteractionMatrix], errors: str
) -> None:
    matrix = case()
    if errors == "none":
        matrix = replace(matrix, sigma=np.zeros_like(matrix.sigma))
    assert find_better_orientation(matrix, MODEL, COLUMNS, TRUTH.to_array()) is None


def test_modes_that_several_orientations_explain_alike_decide_nothing() -> None:
    """One actuator in the middle is the same in any orientation."""
    assert find_better_orientation(measured(0), MODEL, np.array([18]), TRUTH.to_array()) is None


def test_it_is_named_although_the_influence_functions_are_others_too() -> None:
    matrix = thin_plate()
    said = find_better_orientation(replace(matrix, data=-turned(matrix)), MODEL, COLUMNS, np.zeros(5))
    assert said is not None
    assert TURNED in said
    assert POLARITY in said
