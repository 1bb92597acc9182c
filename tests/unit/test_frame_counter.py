"""Counters that wrap, and camera clocks converted to this computer's."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from escape_drivers.common.camera import CameraClock, FrameCounter

BLOCKS = (1, 65535)
WORDS = (0, 2**32 - 1)


@given(
    st.sampled_from([BLOCKS, WORDS]),
    st.integers(0, 65534),
    st.lists(st.integers(1, 30000), min_size=1, max_size=60),
)
def test_steps_survive_any_number_of_turns(limits, start, steps) -> None:
    first, last = limits
    cycle = last - first + 1
    counter, at = FrameCounter(first, last), start
    indices = [counter.index(first + at % cycle)]
    for step in steps:
        at += step
        indices.append(counter.index(first + at % cycle))
    assert [b - a for a, b in pairwise(indices)] == steps


def test_long_identifiers_continue() -> None:
    counter = FrameCounter(*BLOCKS)
    assert [counter.index(n) for n in (65534, 65535, 65536, 70000)] == [65534, 65535, 65536, 70000]


def test_a_counter_that_falls_a_little_stays_fallen() -> None:
    counter = FrameCounter(*BLOCKS)
    assert [counter.index(n) for n in (500, 499, 65535 // 2)] == [500, 499, 32767]


@given(
    st.integers(1, 10**15),
    st.lists(st.tuples(st.integers(10**6, 10**8), st.integers(0, 10**8)), min_size=1, max_size=40),
)
def test_no_frame_is_exposed_after_it_arrived_and_times_rise(offset, frames) -> None:
    clock, stamp, arrived, exposed = CameraClock(), 10**9, 0, []
    for period, delay in frames:
        stamp += period
        arrived = max(arrived + 1, stamp + offset + delay)
        exposed.append(clock.exposed_ns(stamp, arrived))
        assert exposed[-1] <= arrived
    assert all(b > a for a, b in pairwise(exposed))


def test_without_time_stamps_the_arrival_has_to_do() -> None:
    assert CameraClock().exposed_ns(0, 77) == 77


@pytest.mark.parametrize("drift", [-20e-6, 20e-6])
def test_a_camera_clock_that_drifts_is_followed(drift: float) -> None:
    clock, errors = CameraClock(), []
    for frame in range(36_000):
        true_ns = (frame + 1) * 10**8
        arrived_ns = true_ns + (10**6 if frame % 2 else 3 * 10**6)
        errors.append(clock.exposed_ns(round(true_ns * (1 + drift)), arrived_ns) - true_ns)
    # The shortest delay is 1 ms; an hour of drift would be 72 ms.
    assert all(abs(error - 10**6) < 2 * 10**4 for error in errors[1:])
