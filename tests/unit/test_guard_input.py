"""Inputs that the guard accepts as a command, and those that it rejects."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from guard_cases import N, breaches, guard_with, static_breaches
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra import numpy as hnp
from numpy.typing import NDArray

from escape_hw.errors import CommandRejected
from escape_hw.safety.limits import MirrorLimits


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
    assert report.is_unchanged
    assert safe.dtype == np.float64
    assert safe.flags.c_contiguous
    assert np.array_equal(safe, np.full(N, 0.125))
