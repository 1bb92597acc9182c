"""Notebook output: valid images, numbers with units and provenance, escaped text."""

from __future__ import annotations

import base64
import io
import re

import matplotlib.image
import numpy as np
import pytest

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.registration import Registration
from escape_hw.api.representation import image_html, line_html, table_html
from escape_hw.api.results import CalibrationResult, Estimate, RegistrationEstimate, SprintIteration
from escape_hw.remote.state import FaultState, LoopState, Phase, State


def pixels(html: str) -> np.ndarray:
    data = base64.b64decode(re.search(r"base64,([^\"]+)", html)[1])
    return np.round(255 * matplotlib.image.imread(io.BytesIO(data), "png")[..., :3]).astype(int)


def matrix() -> InteractionMatrix:
    valid = np.ones((2, 2), bool)
    data = np.arange(24, dtype=np.float32).reshape(8, 3)
    return InteractionMatrix(
        data, np.full((8, 3), 0.5, np.float32), np.eye(3), valid, "a <b>", "docrime", True, {"frames": 77}
    )


def test_a_picture_shows_signs_by_colour_and_gaps_in_grey() -> None:
    found = pixels(image_html([[-1.0, 0.0, 1.0, np.nan]]))[0]
    assert found[0].tolist() == [59, 76, 192]
    assert found[1].tolist() == [242, 242, 242]
    assert found[2].tolist() == [180, 4, 38]
    assert found[3].tolist() == [160, 160, 160]


@pytest.mark.parametrize("values", [np.zeros((3, 3)), np.full((2, 2), np.nan), np.ones((1, 1))])
def test_pictures_of_nothing(values: np.ndarray) -> None:
    assert pixels(image_html(values)).shape[:2] == values.shape


def test_large_arrays_are_thinned_out() -> None:
    assert len(image_html(np.random.default_rng(0).normal(size=(3000, 1000)))) < 500_000


def test_a_curve_fills_its_height() -> None:
    ys = [
        float(pair.split(",")[1])
        for pair in re.search(r'points="([^"]+)"', line_html([3, 5, np.nan, 4]))[1].split()
    ]
    assert ys == [47.0, 1.0, 24.0]
    assert line_html([1.0]) == ""


def test_a_table_escapes_what_it_is_given() -> None:
    assert "&lt;script&gt;" in table_html({"x": "<script>"})


def test_a_matrix_states_units_errors_and_where_it_is_from() -> None:
    html = matrix()._repr_html_()
    assert "docrime" in html
    assert "a &lt;b&gt; (SIMULATED)" in html
    assert "8 slopes × 3 modes, in pixel per full stroke rms" in html
    assert "77" in html
    assert pixels(html).shape[:2] == (8, 3)


def estimate() -> RegistrationEstimate:
    steps = tuple(SprintIteration(Registration(), 1.0, 10.0**-k, 1.0) for k in range(4))
    return RegistrationEstimate(
        Registration(shift_x=1.5), np.diag([0.04, 1, 1, 1, 1]), Estimate(1, 0.1), Estimate(1, 0.1), True,
        steps, 1.0, ("few frames",),
    )  # fmt: skip


def test_a_registration_states_errors_units_and_convergence() -> None:
    html = estimate()._repr_html_()
    assert "1.500 ± 0.200 % of a sub-aperture" in html
    assert "converged, 4 iterations" in html
    assert "few frames" in html
    assert "<svg" in html


def test_a_calibration_shows_both() -> None:
    class Grid:
        pass

    result = CalibrationResult(matrix(), Grid(), 77, 3, 0.2, registration=estimate(), partial=True)  # type: ignore[arg-type]
    html = result._repr_html_()
    assert "Interaction matrix" in html
    assert "Registration" in html
    assert "PARTIAL" in html
    assert "77, 3 lost, 0.2 s" in html


def test_gains_without_a_round_are_shown_as_such() -> None:
    html = GainsResult("escape", (), (), False, 0.4, 10, 0)._repr_html_()
    assert "converged" in html
    assert "<svg" not in html


def test_a_state_shows_the_fault_and_the_remedy() -> None:
    state = State(
        system="razor", simulated=False, phase=Phase.FAULT,
        fault=FaultState(reason="it broke", at_utc="", remedy="Fix it."),
        loop=LoopState(closed=True, matrix="m"),
    )  # fmt: skip
    html = state._repr_html_()
    assert "razor (HARDWARE)" in html
    assert "it broke. Fix it." in html
    assert "closed on m" in html
