"""Limits of a mirror: what they may be, and which actuators are neighbours."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from guard_cases import PAIRS, guard_with

from escape_hw.safety.guard import CommandGuard
from escape_hw.safety.limits import MirrorLimits, neighbour_pairs


def test_actuators_that_do_not_exist_are_refused() -> None:
    with pytest.raises(ValueError, match=r"0\.\.20"):
        guard_with(MirrorLimits(disabled=(21,)))
    with pytest.raises(ValueError, match="neighbour pairs"):
        CommandGuard("dm", 3, MirrorLimits(), np.array([[1, 3]]))


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"max_stroke": 0.0}, "max_stroke is 0.0"),
        ({"max_stroke": 1.1}, r"\(0, 1\]"),
        ({"max_stroke": np.nan}, "max_stroke is nan"),
        ({"max_slew": 0.0}, "max_slew is 0.0"),
        ({"max_neighbour": -1.0}, "max_neighbour is -1.0"),
        ({"max_mean": np.nan}, "max_mean is nan"),
        ({"max_abs_sum": 0.0}, "max_abs_sum is 0.0"),
        ({"disabled": (-1,)}, "counted from 0"),
        ({"disabled": (0.5,)}, "whole numbers"),
    ],
)
def test_limits_that_mean_nothing_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        MirrorLimits(**values)


def test_disabled_may_be_any_sequence_of_whole_numbers() -> None:
    limits = MirrorLimits(disabled=list(np.array([4, 2])))  # type: ignore[arg-type]
    assert limits.disabled == (4, 2)
    assert limits == MirrorLimits(disabled=(4, 2))
    assert hash(limits) == hash(MirrorLimits(disabled=(4, 2)))


def test_neighbours_share_an_edge_and_are_named_once() -> None:
    layout = np.array([[True, True, False], [False, True, True]])
    pairs = {tuple(int(i) for i in pair) for pair in neighbour_pairs(layout)}
    assert pairs == {(0, 1), (1, 2), (2, 3)}
    assert len(PAIRS) == 32
    with pytest.raises(ValueError, match="rows, columns"):
        neighbour_pairs(np.ones(4, dtype=bool))
