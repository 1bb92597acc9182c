"""The registration against injected values that no estimator reads."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from small_system import GAUSSIAN_TWIN, configuration

from escape_hw.api.procedure import run
from escape_hw.api.registration import PARAMETERS
from escape_hw.paper.sky_time import (
    GOAL,
    HALF_RANGES,
    RealisationErrors,
    random_registration,
    realisation_config,
    run_realisation,
    sky_time,
    summary,
)
from escape_hw.runtime.session.system import System

SYSTEM = "razor-shwfs"


def _meets_goal(curves: dict[str, Any], estimator: str, frames: int) -> bool:
    at = curves["frames"].index(frames)
    return all(curves["estimators"][estimator][p][at] <= goal for p, goal in curves["goal"].items())


@pytest.fixture(scope="module", params=["small bench", pytest.param("bundled bench", marks=pytest.mark.slow)])
def any_size(request: pytest.FixtureRequest) -> list[RealisationErrors]:
    """As ``few``, also on a bench of a quarter of the sub-apertures."""
    if request.param == "bundled bench":
        found: list[RealisationErrors] = request.getfixturevalue("few")
        return found
    return [run_realisation(configuration(), number, (300,), GAUSSIAN_TWIN) for number in (0, 1)]


@pytest.fixture(scope="module")
def few() -> list[RealisationErrors]:
    """A registration, every imperfection but the places of the actuators, 0.6 seconds of frames."""
    return [run_realisation(SYSTEM, 0, (300,), GAUSSIAN_TWIN)]


def test_registrations_fill_their_ranges_and_differ() -> None:
    drawn = np.array([random_registration(n).to_array() for n in range(200)])
    assert (np.abs(drawn) <= HALF_RANGES).all()
    assert (drawn.std(axis=0) > 0.5 * HALF_RANGES).all()


@pytest.mark.slow
def test_three_hundred_frames_meet_the_goal(few: Sequence[RealisationErrors]) -> None:
    curves = summary(few, (300,))
    assert _meets_goal(curves, "whitened", 300)
    assert curves["fewest_frames"]["whitened"] == 300


@pytest.mark.slow
def test_whitening_is_what_meets_it(few: Sequence[RealisationErrors]) -> None:
    curves = summary(few, (300,))
    assert not _meets_goal(curves, "unwhitened", 300)
    unwhitened, whitened = (
        np.array([curves["estimators"][e][p][0] for p in PARAMETERS]) for e in ("unwhitened", "whitened")
    )
    assert (unwhitened / whitened).mean() > 3


def test_no_error_is_beyond_what_its_sigma_allows(any_size: Sequence[RealisationErrors]) -> None:
    pulls = np.array([p.errors / p.sigmas for p in any_size])
    assert np.abs(pulls).max() < 5
    assert 0.2 < np.mean(pulls[:, 1] ** 2) < 3


def test_no_error_and_no_stated_error_is_below_the_bound(any_size: Sequence[RealisationErrors]) -> None:
    for realisation in any_size:
        assert (realisation.sigmas[1, 0] > realisation.exact[0]).all()


#: A nominal mirror of another family than the true one, whose functions differ over the whole mirror.
THIN_PLATE = [
    "devices.dm.influence=gaussian", "devices.dm.coupling=0.4", "twin.mirror.shape=thin-plate",
    "twin.mirror.coupling=0.41", "twin.mirror.wing_fraction=0", "twin.mirror.gain_scatter=0.05",
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("number", [21, 24])
def test_a_fit_of_a_thin_plate_is_right_within_its_errors_or_says_that_it_failed(number: int) -> None:
    injected, config = realisation_config(SYSTEM, number, THIN_PLATE)
    with System.from_config(config) as bench:
        found = bench.calibrate("escape", frames=1000).registration
    assert found is not None
    # Five of the six realisations 20 to 25 converge, not 24.
    assert found.converged or (number == 24 and found.warnings)
    assert found.actuator_corrections is not None
    # The common gain is theirs: with a free mean it was ten times too large, and all of them far below it.
    assert abs(found.actuator_corrections.gain.mean()) < 1e-3
    errors = found.registration.to_array() - injected.to_array()
    assert np.abs(errors / found.sigma).max() < 3


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_ten_registrations_from_fifty_and_a_thousand_frames() -> None:
    """The paper's goal from a tenth of its frames and less, with correct errors of every parameter."""
    curves = run(sky_time(SYSTEM, realisations=10, frames=(50, 1000), overrides=GAUSSIAN_TWIN))
    for estimator, frames in (("whitened", 1000), ("telemetry", 50), ("telemetry", 1000)):
        assert _meets_goal(curves, estimator, frames)
        at = curves["frames"].index(frames)
        for name in PARAMETERS:
            # The matrix route states shift and rotation up to three times as large as it errs on
            # mirrors that are nearly as its model has them: its errors contain those of other mirrors.
            least = 0.2 if estimator == "telemetry" else 0.07
            assert least <= curves["chi2"][estimator][name][at] <= 2.5, (estimator, frames, name)
    assert (np.array([curves["bound"][p][0] for p in PARAMETERS]) < GOAL).all()
