"""The guard: every output satisfies all limits, and valid commands pass unchanged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from guard_cases import PAIRS, ROUNDING, N, breaches, guard_with, static_breaches
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from escape_hw.safety.guard import CommandGuard, load_compiled_check
from escape_hw.safety.limits import MirrorLimits

positive = st.floats(1e-4, 2.0)
any_limits = st.builds(
    MirrorLimits,
    max_stroke=st.floats(0.01, 1.0),
    max_slew=st.none() | positive,
    max_neighbour=st.none() | positive,
    max_mean=st.none() | positive,
    max_abs_sum=st.none() | st.floats(1e-3, 40.0),
    disabled=st.lists(st.integers(0, N - 1), max_size=N).map(tuple),
)
finite = st.floats(allow_nan=False, allow_infinity=False)
sensible = st.floats(-1.5, 1.5)
commands = hnp.arrays(np.float64, N, elements=finite | sensible, fill=sensible)


@settings(max_examples=300, deadline=None)
@given(limits=any_limits, sequence=st.lists(commands, min_size=1, max_size=6))
def test_whatever_goes_in_what_comes_out_obeys(
    limits: MirrorLimits, sequence: list[NDArray[np.float64]]
) -> None:
    guard = guard_with(limits)
    for command in sequence:
        before = guard.last
        safe, _ = guard(command)
        assert breaches(limits, before, safe) == []
        assert guard.is_legal(safe)


@settings(max_examples=200, deadline=None)
@given(limits=any_limits, first=commands, second=commands)
def test_what_was_let_through_is_let_through_again_untouched(
    limits: MirrorLimits, first: NDArray[np.float64], second: NDArray[np.float64]
) -> None:
    guard = guard_with(limits)
    guard(first)
    safe, _ = guard(second)
    again, report = guard(safe)
    assert report.is_unchanged
    assert np.array_equal(again, safe)


@settings(max_examples=200, deadline=None)
@given(limits=any_limits, start=commands, direction=commands, share=st.floats(0.0, 0.99))
def test_valid_commands_pass_bit_for_bit(
    limits: MirrorLimits, start: NDArray[np.float64], direction: NDArray[np.float64], share: float
) -> None:
    guard = guard_with(limits)
    guard(start)
    goal, _ = guard.limit(direction)
    legal = guard.last + share * (goal - guard.last)
    if breaches(limits, guard.last, legal):
        return
    safe, report = guard(legal)
    assert report.is_unchanged
    assert np.array_equal(safe, legal)


@settings(max_examples=100, deadline=None)
@given(limits=any_limits, start=commands, target=commands)
def test_repeating_a_command_arrives(
    limits: MirrorLimits, start: NDArray[np.float64], target: NDArray[np.float64]
) -> None:
    guard = guard_with(limits)
    guard(start)
    unhurried = CommandGuard(
        "dm",
        N,
        replace(limits, max_slew=None),
        PAIRS,
    )
    goal, _ = unhurried.limit(target)
    far = float(np.abs(goal - guard.last).max())
    previous = np.inf
    for _ in range(50):
        guard(target)
        now = float(np.abs(goal - guard.last).max())
        assert now < previous or now <= ROUNDING, "stuck on the way"
        previous = now
    reach = np.inf if limits.max_slew is None else 50 * limits.max_slew
    each_alone = limits.max_neighbour is limits.max_mean is limits.max_abs_sum is None
    if far < 0.5 * reach and each_alone:
        assert previous <= ROUNDING


@settings(max_examples=100, deadline=None)
@given(limits=any_limits, found=hnp.arrays(np.float64, N, elements=st.floats(-3, 3)), asked=commands)
def test_from_an_illegal_shape_each_command_comes_nearer(
    limits: MirrorLimits, found: NDArray[np.float64], asked: NDArray[np.float64]
) -> None:
    guard = guard_with(limits)
    guard.reset(found)
    for _ in range(400):
        before = guard.last
        safe, _ = guard(asked)
        if limits.max_slew is not None:
            assert np.abs(safe - before).max() <= limits.max_slew + ROUNDING
        assert np.abs(safe).max() <= max(np.abs(before).max(), limits.max_stroke) + ROUNDING
        if not static_breaches(limits, safe):
            break
    if limits.max_slew is None or limits.max_slew > 0.05:
        assert static_breaches(limits, safe) == []


def test_what_is_loaded_is_what_a_guard_with_every_rule_calls(monkeypatch) -> None:
    called = []

    def record(*arguments) -> bool:
        called.append(
            [
                (a.dtype, a.ndim, a.flags.writeable) if isinstance(a, np.ndarray) else type(a)
                for a in arguments
            ]
        )
        return True

    monkeypatch.setattr("escape_hw.safety.compiled_check.obeys_limits", record)
    load_compiled_check()
    limits = MirrorLimits(max_stroke=0.5, max_slew=0.2, max_neighbour=0.4, max_mean=0.1, max_abs_sum=5.0)
    CommandGuard("dm", N, limits, PAIRS).limit(np.full(N, 0.01))
    assert len(called) >= 2
    assert all(one == called[0] for one in called)
