"""The guard: whatever goes in, what comes out obeys every limit, and legal commands pass untouched."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from escape_hw.errors import CommandRejected
from escape_hw.safety.guard import CommandGuard
from escape_hw.safety.limits import MirrorLimits, neighbour_pairs

AXIS = np.arange(5) - 2
LAYOUT = AXIS[:, None] ** 2 + AXIS**2 <= 5
N = int(LAYOUT.sum())
PAIRS = neighbour_pairs(LAYOUT)
ROUNDING = 1e-10

positive = st.floats(1e-4, 2.0)
any_limits = st.builds(
    MirrorLimits,
    max_stroke=st.floats(0.01, 1.0),
    max_slew=st.none() | positive,
    max_neighbour=st.none() | positive,
    max_mean=st.none() | positive,
    disabled=st.lists(st.integers(0, N - 1), max_size=N).map(tuple),
)
finite = st.floats(allow_nan=False, allow_infinity=False)
sensible = st.floats(-1.5, 1.5)
commands = hnp.arrays(np.float64, N, elements=finite | sensible, fill=sensible)


def guard_with(limits: MirrorLimits) -> CommandGuard:
    return CommandGuard("dm", N, limits, PAIRS)


def static_breaches(lim: MirrorLimits, shape: NDArray[np.float64]) -> list[str]:
    """Rules that a shape breaks by itself, written out again from their definitions."""
    enabled = [i for i in range(N) if i not in lim.disabled]
    broken = []
    if not np.isfinite(shape).all():
        broken.append("finite")
    if max(abs(shape)) > lim.max_stroke:
        broken.append("stroke")
    if any(shape[i] != 0 for i in lim.disabled):
        broken.append("disabled")
    if lim.max_mean is not None and enabled and abs(np.mean(shape[enabled])) > lim.max_mean + ROUNDING:
        broken.append("mean")
    if lim.max_neighbour is not None:
        worst = max(abs(shape[a] - shape[b]) for a, b in PAIRS)
        if worst > lim.max_neighbour + ROUNDING:
            broken.append("neighbour")
    return broken


def breaches(lim: MirrorLimits, before: NDArray[np.float64], after: NDArray[np.float64]) -> list[str]:
    broken = static_breaches(lim, after)
    if lim.max_slew is not None and max(abs(after - before)) > lim.max_slew + ROUNDING:
        broken.append("slew")
    return broken


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
        assert guard.obeys(safe)


@settings(max_examples=200, deadline=None)
@given(limits=any_limits, first=commands, second=commands)
def test_what_was_let_through_is_let_through_again_untouched(
    limits: MirrorLimits, first: NDArray[np.float64], second: NDArray[np.float64]
) -> None:
    guard = guard_with(limits)
    guard(first)
    safe, _ = guard(second)
    again, report = guard(safe)
    assert report.untouched
    assert np.array_equal(again, safe)


@settings(max_examples=200, deadline=None)
@given(limits=any_limits, start=commands, direction=commands, share=st.floats(0.0, 0.99))
def test_legal_commands_pass_bit_for_bit(
    limits: MirrorLimits, start: NDArray[np.float64], direction: NDArray[np.float64], share: float
) -> None:
    guard = guard_with(limits)
    guard(start)
    goal, _ = guard.limit(direction)
    legal = guard.last + share * (goal - guard.last)
    if breaches(limits, guard.last, legal):
        return
    safe, report = guard(legal)
    assert report.untouched
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
        MirrorLimits(limits.max_stroke, None, limits.max_neighbour, limits.max_mean, limits.disabled),
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
    if far < 0.5 * reach and limits.max_neighbour is None and limits.max_mean is None:
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


@settings(max_examples=100, deadline=None)
@given(
    command=hnp.arrays(np.float64, N, elements=st.floats(-1, 1)),
    index=st.integers(0, N - 1),
    value=st.sampled_from([np.nan, np.inf, -np.inf]),
)
def test_one_bad_value_rejects_the_whole(command: NDArray[np.float64], index: int, value: float) -> None:
    guard = guard_with(MirrorLimits())
    guard(np.full(N, 0.1))
    before = guard.last
    command[index] = value
    with pytest.raises(CommandRejected, match=f"actuator {index} is {value}"):
        guard(command)
    assert guard.last is before


@settings(max_examples=200, deadline=None)
@given(
    command=hnp.arrays(
        hnp.scalar_dtypes() | hnp.array_dtypes(),
        hnp.array_shapes(min_dims=0, max_dims=2, max_side=N + 1) | st.just((N,)),
    )
    | st.recursive(st.none() | st.booleans() | st.floats() | st.text() | st.complex_numbers(), st.lists)
)
def test_any_object_is_limited_or_rejected(command: Any) -> None:
    guard = guard_with(MirrorLimits(0.8, 0.3, 0.4, 0.1, (2,)))
    before = guard.last
    try:
        safe, _ = guard(command)
    except CommandRejected:
        assert guard.last is before
    else:
        assert breaches(guard.limits, before, safe) == []


WRONG_TYPES: dict[str, Any] = {
    "bool": np.ones(N, dtype=bool),
    "complex": np.ones(N, dtype=complex),
    "object": np.array([0.1] * N, dtype=object),
    "text": ["0.1"] * N,
    "bytes": b"\x00" * N,
    "times": np.zeros(N, dtype="m8[s]"),
    "ragged": [[0.0], *[[0.0, 1.0]] * (N - 1)],
    "huge whole numbers": [2**80] * N,
    "masked": np.ma.masked_array(np.zeros(N), mask=[True] + [False] * (N - 1)),
    "none": None,
    "matrix": np.zeros((1, N)),
    "short": np.zeros(N - 1),
    "scalar": 0.0,
}


@pytest.mark.parametrize("kind", WRONG_TYPES)
def test_wrong_types_are_rejected_whatever_numpy_thinks(kind: str) -> None:
    guard = guard_with(MirrorLimits())
    with np.errstate(all="raise"), pytest.raises(CommandRejected):
        guard(WRONG_TYPES[kind])


def test_an_array_that_cannot_be_made_is_rejected_with_its_cause() -> None:
    class Hostile:
        def __array__(self, *args: Any, **kwargs: Any) -> Any:
            raise RuntimeError("no memory on the other side")

    with pytest.raises(CommandRejected, match="no memory on the other side") as caught:
        guard_with(MirrorLimits())(Hostile())
    assert isinstance(caught.value.__cause__, RuntimeError)


def test_enormous_values_do_not_disturb_a_caller_who_has_numpy_raise() -> None:
    guard = guard_with(MirrorLimits(0.8, None, 0.4, 0.1))
    signs = np.where(np.arange(N) % 2, 1.0, -1.0)
    with np.errstate(all="raise"):
        for command in (np.full(N, 1e308), 1e308 * signs, np.full(N, 5e-324)):
            safe, _ = guard(command)
            assert static_breaches(guard.limits, safe) == []
        with pytest.raises(CommandRejected, match="actuator 0 is"):
            guard(np.full(N, np.longdouble("1e400")))


@pytest.mark.parametrize(
    "command",
    [
        np.full(N, 0.125, dtype=np.float32),
        np.full(N, 0.125, dtype=np.float16),
        np.full(N, 0.125, dtype=">f8"),
        np.full(2 * N, 0.125)[::2],
        np.full(N, 0.125)[::-1],
        np.broadcast_to(np.float64(0.125), (N,)),
        [0.125] * N,
        (0.125,) * N,
    ],
    ids=["float32", "float16", "big-endian", "strided", "backwards", "read-only", "list", "tuple"],
)
def test_every_real_array_is_taken(command: Any) -> None:
    safe, report = guard_with(MirrorLimits())(command)
    assert report.untouched
    assert safe.dtype == np.float64
    assert safe.flags.c_contiguous
    assert np.array_equal(safe, np.full(N, 0.125))


def test_the_answer_cannot_be_changed_by_anyone() -> None:
    guard = guard_with(MirrorLimits())
    command = np.full(N, 0.1)
    safe, _ = guard(command)
    command[:] = 0.9
    assert np.array_equal(guard.last, np.full(N, 0.1))
    with pytest.raises(ValueError, match="read-only"):
        safe[0] = 0.9
    for limited in (
        guard.limit(np.full(N, 3.0))[0],
        guard_with(MirrorLimits(max_slew=0.1)).limit([0.5] * N)[0],
    ):
        assert not limited.flags.writeable


def test_limit_remembers_nothing_before_it_is_accepted() -> None:
    guard = guard_with(MirrorLimits(max_slew=0.1))
    first, _ = guard.limit(np.full(N, 1.0))
    second, _ = guard.limit(np.full(N, 1.0))
    assert np.array_equal(first, second)
    guard.accept(first)
    third, _ = guard.limit(np.full(N, 1.0))
    np.testing.assert_allclose(third, 0.2)


def test_report_says_what_was_done() -> None:
    command = np.zeros(N)
    command[[4, 5]] = 2.0, -2.0
    _, report = guard_with(MirrorLimits(max_stroke=0.5))(command)
    assert (report.clipped, report.untouched) == (2, False)

    _, report = guard_with(MirrorLimits(disabled=(4,)))(command / 4)
    assert (report.disabled, report.clipped) == (1, 0)

    safe, report = guard_with(MirrorLimits(max_slew=0.1))(command / 4)
    assert report.slewed == 2
    np.testing.assert_allclose(safe[[4, 5]], [0.1, -0.1])

    safe, report = guard_with(MirrorLimits(max_mean=0.1))(np.full(N, 0.6))
    assert report.mean_removed == pytest.approx(0.5)
    np.testing.assert_allclose(safe, 0.1)

    a, b = PAIRS[0]
    steep = np.zeros(N)
    steep[[a, b]] = 0.4, -0.4
    safe, report = guard_with(MirrorLimits(max_neighbour=0.2))(steep)
    assert report.scale == pytest.approx(0.25)
    np.testing.assert_allclose(safe, 0.25 * steep)


def test_one_actuator_far_away_does_not_hold_the_others_back() -> None:
    command = np.full(N, 0.05)
    command[7] = 1.0
    safe, report = guard_with(MirrorLimits(max_slew=0.1))(command)
    assert report.slewed == 1
    assert safe[7] == pytest.approx(0.1)
    np.testing.assert_allclose(np.delete(safe, 7), 0.05)


def test_actuators_that_lag_do_not_let_the_mean_drift() -> None:
    command = np.full(N, 0.1)
    command[0] = -0.1 * (N - 1)
    command *= 0.4
    assert command.mean() == pytest.approx(0)
    limits = MirrorLimits(max_slew=0.05, max_mean=0.005)
    guard = guard_with(limits)
    for _ in range(30):
        before = guard.last
        safe, _ = guard(command)
        assert breaches(limits, before, safe) == []
    np.testing.assert_allclose(safe, command, atol=1e-12)


def test_rounding_never_adds_to_the_stroke() -> None:
    stroke, start = 0.3, -0.28
    assert start + (stroke - start) > stroke
    guard = guard_with(MirrorLimits(max_stroke=stroke, max_slew=0.59))
    guard.reset([start] * (N - 1) + [-stroke])
    safe, report = guard(np.full(N, stroke))
    assert report.slewed == 1
    assert safe.max() == safe[0] == stroke


@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_an_absurd_piston_keeps_its_sign(sign: float) -> None:
    safe, report = guard_with(MirrorLimits(max_mean=0.1))(np.full(N, sign * 1e308))
    np.testing.assert_allclose(safe, sign * 0.1)
    assert np.isfinite(report.mean_removed)


@pytest.mark.parametrize(
    ("limits", "shape", "words"),
    [
        (MirrorLimits(max_stroke=0.5), np.eye(N)[3], "actuator 3 exceeds max_stroke = 0.5"),
        (MirrorLimits(disabled=(6,)), 0.1 * np.eye(N)[6], "actuator 6 is disabled"),
        (MirrorLimits(max_mean=0.1), np.full(N, 0.2), "max_mean = 0.1"),
        (MirrorLimits(max_neighbour=0.1), 0.2 * np.eye(N)[6], "max_neighbour = 0.1"),
    ],
)
def test_breach_names_the_rule(limits: MirrorLimits, shape: NDArray[np.float64], words: str) -> None:
    guard = guard_with(limits)
    told = guard.breach(shape)
    assert told is not None
    assert words in told
    assert guard.breach(np.zeros(N)) is None


def test_reset_takes_the_shape_found_and_refuses_nonsense() -> None:
    guard = guard_with(MirrorLimits(max_slew=0.1))
    guard.reset(np.full(N, 0.5))
    np.testing.assert_allclose(guard(np.zeros(N))[0], 0.4)
    with pytest.raises(CommandRejected, match="not finite"):
        guard.reset(np.full(N, np.nan))
    guard.reset()
    assert not guard.last.any()


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
