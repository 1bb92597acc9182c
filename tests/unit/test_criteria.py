"""Criteria of a reproduced result, where the runs do not determine it."""

from __future__ import annotations

import math
from dataclasses import replace

import fake_results as fake

from escape_hw.api.results import Estimate, StrehlEstimate
from escape_hw.report.tables import criterion_symbol, strehl_table
from escape_hw.runtime.procedures import criteria

UNKNOWN = Estimate(0.6, math.nan)


def met(escape=None) -> list[bool]:
    """Which of the criteria a loop with ESCAPE's matrix meets beside a usual one with push-pull's."""
    found = criteria.loop_criteria(
        {"push-pull": fake.loop("push-pull"), "ESCAPE": escape or fake.loop("escape")}
    )
    return [check["met"] for check in found]


def test_loops_of_the_same_strehl_ratio_meet_all():
    assert met() == [True] * 5


def test_loops_too_short_for_a_strehl_ratio_do_not_count_as_compared():
    assert met(escape=replace(fake.loop(), strehl=None)) == [True, True, False]
    unknown = StrehlEstimate(UNKNOWN, UNKNOWN, UNKNOWN)
    assert met(escape=replace(fake.loop(), strehl=unknown)) == [True, True, False]


def test_a_model_that_does_not_fit_is_met_with_a_limitation():
    good, poor = (
        criteria.sprint_converged("ESCAPE", fake.calibration(fits=fits).registration)
        for fits in (True, False)
    )
    assert (good["text"], criterion_symbol(good)) == ("ESCAPE: SPRINT converged", "✓")
    assert poor["met"]
    assert poor["text"] == "ESCAPE: SPRINT converged, but the model does not fit"
    assert criterion_symbol(poor) == "!"


def test_a_loop_that_is_not_stable_is_reported_once():
    found = criteria.loop_criteria(
        {"push-pull": replace(fake.loop("push-pull"), stable=False, strehl=None), "ESCAPE": fake.loop()}
    )
    assert [check["text"] for check in found if not check["met"]] == ["push-pull: loop stable"]


def test_without_a_science_camera_there_is_nothing_to_compare():
    assert met(escape=replace(fake.loop(), strehl=None, model_psf=None)) == [True, True]


def test_a_worse_strehl_ratio_is_not_met():
    assert met(escape=fake.loop(strehl=0.5)) == [True, True, False, False, False]


def test_a_difference_within_the_margin_is_met_and_one_beyond_it_is_not():
    for below, expected in ((0.0035, True), (0.0075, False)):
        ours, theirs = (
            replace(
                fake.loop(),
                strehl=StrehlEstimate(*3 * [Estimate(value, 5e-4)]),
            )
            for value in (0.6 - below, 0.6)
        )
        found = criteria.loop_criteria({"push-pull": theirs, "ESCAPE": ours})
        assert [check["met"] for check in found] == [True, True] + 3 * [expected]


def test_a_ratio_without_an_error_says_so_in_the_table():
    unknown = StrehlEstimate(UNKNOWN, UNKNOWN, UNKNOWN)
    row = strehl_table({"ESCAPE": replace(fake.loop(), strehl=unknown)}).rows[0]
    assert row[1] == "60.0 ± ?"
