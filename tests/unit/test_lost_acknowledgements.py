"""Commands whose acknowledgement is lost: the mirror may have moved, or not."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from escape_hw.errors import DeviceError
from escape_hw.safety.guard import CommandGuard
from escape_hw.safety.limits import MirrorLimits
from escape_hw.testing.faulty_devices import FaultyMirror
from escape_hw.testing.reference_devices import RecordingMirror

N = 21
LIMITS = st.builds(
    MirrorLimits,
    max_stroke=st.floats(0.1, 1.0),
    max_slew=st.floats(0.01, 1.0),
    max_neighbour=st.none() | st.floats(0.01, 1.0),
    max_mean=st.none() | st.floats(0.01, 1.0),
    max_abs_sum=st.none() | st.floats(0.5, 20.0),
    disabled=st.lists(st.integers(0, N - 1), max_size=5).map(tuple),
)


class UnacknowledgedMirror(RecordingMirror):
    """A mirror whose transfers end as listed: ``ok``, ``lost`` before or ``late`` after they took effect."""

    def __init__(self, limits: MirrorLimits | None = None, ends: tuple[str, ...] = ()) -> None:
        super().__init__("dm", limits)
        self.ends = list(ends)

    def _send(self, command: NDArray[np.float64]) -> None:
        end = self.ends.pop(0) if self.ends else "ok"
        if end != "lost":
            super()._send(command)
        if end != "ok":
            raise DeviceError(self.name, "no acknowledgement in time")


@pytest.mark.parametrize("max_slew", [None, 0.3])
def test_flatten_sends_after_a_lost_acknowledgement(max_slew: float | None) -> None:
    with UnacknowledgedMirror(MirrorLimits(max_slew=max_slew)) as dm:
        dm.flatten()
        dm.ends = ["late"]
        with pytest.raises(DeviceError):
            dm.send(np.full(N, 0.2))
        assert dm.history[-1].any(), "the mirror moved"
        assert not dm.shape.any(), "the last accepted shape"
        dm.flatten()
        assert not dm.history[-1].any()


def test_closing_flattens_a_mirror_whose_last_acknowledgement_was_lost() -> None:
    inner = RecordingMirror()
    dm = FaultyMirror(inner, unacknowledged=[0])
    with dm:
        dm.flatten()
        with pytest.raises(DeviceError, match="not acknowledged"):
            dm.send(np.full(N, 0.2))
        assert inner.history[-1].any()
    assert not dm.reached[-1].any()


@settings(max_examples=150, deadline=None)
@given(limits=LIMITS, ends=st.lists(st.sampled_from(["ok", "lost", "late"]), max_size=12),
       seed=st.integers(0, 2**32 - 1))  # fmt: skip
def test_the_true_steps_obey_the_slew_limit(limits: MirrorLimits, ends: list[str], seed: int) -> None:
    rng = np.random.default_rng(seed)
    with UnacknowledgedMirror(limits) as dm:
        dm.flatten()
        dm.ends = ends
        for _ in range(len(dm.ends)):
            try:
                dm.send(rng.choice([0.05, 1.0, 1e6]) * rng.standard_normal(N))
            except DeviceError:
                continue
        dm.flatten()
        assert not dm.history[-1].any()
        assert limits.max_slew is not None
        for before, after in pairwise(dm.history):
            assert np.abs(after - before).max() <= limits.max_slew + 1e-9


def test_a_shape_beyond_reach_of_an_uncertain_one_is_not_legal() -> None:
    guard = CommandGuard("dm", 1, MirrorLimits(max_slew=0.1))
    guard.mark_uncertain(np.array([0.1]))
    assert not guard.is_legal(np.array([-0.05]))
    assert guard.limit([-0.05])[0] == pytest.approx(0.0)
    assert guard.limit([0.5])[0] == pytest.approx(0.1)
    guard.reset([0.0])
    assert guard.is_legal(np.array([-0.05]))


@settings(max_examples=100, deadline=None)
@given(limits=LIMITS, n_shapes=st.integers(1, 8), seed=st.integers(0, 2**32 - 1))
def test_the_first_step_after_a_sequence_is_as_short_as_its_shapes_allow(
    limits: MirrorLimits, n_shapes: int, seed: int
) -> None:
    rng = np.random.default_rng(seed)
    guard = CommandGuard("dm", N, limits)
    possible = [guard.last]
    for _ in range(n_shapes):
        possible.append(guard(rng.choice([0.05, 1.0]) * rng.standard_normal(N))[0])
    guard.reset(possible[0])
    guard.mark_sequence(possible[1:])

    def farthest(shape: NDArray[np.float64]) -> float:
        return max(float(np.abs(shape - other).max()) for other in possible)

    assert limits.max_slew is not None
    sent, _ = guard(rng.standard_normal(N))
    assert farthest(sent) <= max(limits.max_slew, min(map(farthest, possible[1:]))) + 1e-9
    guard(rng.standard_normal(N))
    assert np.abs(guard.last - sent).max() <= limits.max_slew + 1e-9
