"""Deformable mirrors: opening, closing, flattening and counting around the guard."""

from __future__ import annotations

import threading
import time
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from escape_hw.api.mirror import DMInfo
from escape_hw.errors import CommandRejected, DeviceError, DeviceLost, NotOpen, SettingRejected
from escape_hw.safety.limits import MirrorLimits
from escape_hw.testing.reference_devices import RecordingMirror

N = 21


class Flaky(RecordingMirror):
    """A mirror whose link and opening can be made to fail, and that says when it is closed."""

    def __init__(self, limits: MirrorLimits | None = None) -> None:
        super().__init__("dm", limits)
        self.lost = False
        self.closings = 0
        self.close_error: Exception | None = None
        self.open_error: Exception | None = None
        self.abandoned = 0
        self.found: NDArray[np.float64] | None = None

    def _open(self) -> None:
        if self.open_error is not None:
            raise self.open_error

    def _release_after_failed_open(self) -> None:
        self.abandoned += 1

    def _close(self) -> None:
        self.closings += 1
        if self.close_error is not None:
            raise self.close_error

    def _present_shape(self) -> NDArray[np.float64] | None:
        return self.found

    def _send(self, command: NDArray[np.float64]) -> None:
        if self.lost:
            raise DeviceLost(self.name, "cable out")
        super()._send(command)


def steps(shapes: list[NDArray[np.float64]]) -> float:
    return max(float(np.abs(b - a).max()) for a, b in zip([np.zeros(N), *shapes], shapes, strict=False))


def test_flatten_after_open_sends_even_when_flat_is_zero() -> None:
    with RecordingMirror() as dm:
        dm.flatten()
        assert len(dm.history) == 1
        dm.flatten()
        assert len(dm.history) == 1


def test_flatten_after_reopening_sends_again() -> None:
    dm = RecordingMirror()
    with dm:
        dm.send(np.full(N, 0.1))
    before = len(dm.history)
    with dm:
        dm.flatten()
        assert len(dm.history) == before + 1


@settings(max_examples=60, deadline=None)
@given(
    limits=st.builds(
        MirrorLimits,
        max_stroke=st.floats(0.1, 1.0),
        max_slew=st.none() | st.floats(1e-3, 1.0),
        max_neighbour=st.none() | st.floats(0.01, 1.0),
        max_mean=st.none() | st.floats(0.01, 1.0),
        max_abs_sum=st.none() | st.floats(0.5, 20.0),
        disabled=st.lists(st.integers(0, N - 1), max_size=5).map(tuple),
    ),
    seed=st.integers(0, 2**32 - 1),
)
def test_flatten_arrives_from_anywhere_under_any_limits(limits: MirrorLimits, seed: int) -> None:
    rng = np.random.default_rng(seed)
    with RecordingMirror(limits=limits) as dm:
        guard = dm._guard_when_open()
        flat, *_ = guard._apply_static_limits(rng.standard_normal(N))
        dm.set_flat(flat)
        for _ in range(3):
            dm.send(rng.standard_normal(N))
        away = len(dm.history)
        dm.flatten()
        assert np.array_equal(dm.history[-1], flat)
        ramp = dm.history[away - 1 :]
        largest = max((float(np.abs(b - a).max()) for a, b in pairwise(ramp)), default=0.0)
        assert largest <= min(dm.RAMP_STEP, limits.max_slew or 1.0) + 1e-9


def test_flatten_recovers_a_mirror_found_beyond_its_limits() -> None:
    dm = Flaky(MirrorLimits(max_stroke=0.5, max_slew=0.05))
    dm.found = np.linspace(-1.0, 1.0, N)
    with dm:
        assert np.array_equal(dm.shape, dm.found)
        dm.flatten()
        assert not dm.shape.any()
        shapes = [dm.found, *dm.history]
        assert all(np.abs(b - a).max() <= 0.05 + 1e-9 for a, b in pairwise(shapes))


def test_a_mirror_known_to_be_flat_is_left_alone() -> None:
    dm = Flaky()
    dm.found = np.zeros(N)
    with dm:
        pass
    assert dm.history == []


def test_close_flattens_after_errors() -> None:
    dm = RecordingMirror(limits=MirrorLimits(max_slew=0.05))

    def work() -> None:
        with dm:
            for _ in range(10):
                dm.send(np.full(N, 0.4))
            with pytest.raises(CommandRejected):
                dm.send(np.full(N, np.nan))
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        work()
    assert not dm.history[-1].any()
    assert steps(dm.history) <= 0.05 + 1e-9


def test_a_lost_mirror_is_closed_and_the_loss_reported() -> None:
    dm = Flaky()
    dm.open()
    dm.send(np.full(N, 0.1))
    dm.lost = True
    with pytest.raises(DeviceLost, match="dm: cable out"):
        dm.close()
    assert not dm.is_open
    assert dm.closings == 1
    dm.close()
    assert dm.closings == 1


def test_the_first_cause_comes_out_of_with() -> None:
    dm = Flaky()

    def work() -> None:
        with dm:
            dm.send(np.full(N, 0.1))
            dm.lost = True
            raise ZeroDivisionError("the first cause")

    with pytest.raises(ZeroDivisionError) as caught:
        work()
    assert any("cable out" in note for note in caught.value.__notes__)
    assert dm.closings == 1


def test_what_is_lost_says_so_once(caplog: pytest.LogCaptureFixture) -> None:
    dm = Flaky()

    def work() -> None:
        with dm:
            dm.send(np.full(N, 0.1))
            dm.lost = True
            dm.send(np.full(N, 0.2))

    with pytest.raises(DeviceLost, match="cable out") as caught:
        work()
    assert not getattr(caught.value, "__notes__", [])
    assert not caplog.records
    assert dm.closings == 1


def test_a_failed_flatten_is_not_hidden_by_a_failed_disconnection() -> None:
    dm = Flaky()
    dm.open()
    dm.send(np.full(N, 0.1))
    dm.lost, dm.close_error = True, OSError("port gone")
    with pytest.raises(DeviceLost, match="cable out") as caught:
        dm.close()
    assert any("port gone" in note for note in caught.value.__notes__)
    assert not dm.is_open


def test_a_failed_opening_leaves_nothing_half_open() -> None:
    dm = Flaky()
    dm.open_error = DeviceError("dm", "no answer")
    with pytest.raises(DeviceError, match="no answer"):
        dm.open()
    assert (dm.is_open, dm.abandoned) == (False, 1)
    dm.open_error = None
    with dm:
        dm.send(np.zeros(N))


def test_limits_that_do_not_fit_are_refused_on_opening_and_the_link_closed() -> None:
    dm = Flaky(MirrorLimits(disabled=(N,)))
    with pytest.raises(SettingRejected, match=r"dm: its limits do not fit .*0\.\.20"):
        dm.open()
    assert (dm.is_open, dm.closings) == (False, 1)


def test_a_layout_that_contradicts_the_actuators_is_refused() -> None:
    class Odd(RecordingMirror):
        @property
        def info(self) -> DMInfo:
            return replace(super().info, layout=np.ones((5, 5), dtype=bool))

    with pytest.raises(DeviceError, match="25 positions for 21 actuators"):
        Odd().open()


def test_a_failed_transfer_keeps_the_last_shape_as_the_origin_of_slew() -> None:
    dm = Flaky(MirrorLimits(max_slew=0.1))
    with dm:
        dm.send(np.full(N, 0.1))
        dm.lost = True
        for _ in range(3):
            with pytest.raises(DeviceLost):
                dm.send(np.full(N, 0.2))
        assert np.array_equal(dm.shape, np.full(N, 0.1))
        assert dm.sent_count == 1
        dm.lost = False
        np.testing.assert_allclose(dm.send(np.full(N, 1.0)).sent, 0.2)


def test_an_interrupted_transfer_keeps_the_last_shape() -> None:
    class Interrupted(RecordingMirror):
        def _send(self, command: NDArray[np.float64]) -> None:
            if command.any():
                raise KeyboardInterrupt
            super()._send(command)

    with Interrupted() as dm:
        with pytest.raises(KeyboardInterrupt):
            dm.send(np.full(N, 0.1))
        assert not dm.shape.any()


def test_a_driver_cannot_write_into_the_shape() -> None:
    class Scribbler(RecordingMirror):
        def _send(self, command: NDArray[np.float64]) -> None:
            if command.any():
                command *= 2.0

    with Scribbler() as dm:
        with pytest.raises(DeviceError, match="read-only"):
            dm.send(np.full(N, 0.6))
        assert not dm.shape.any()


@pytest.mark.parametrize(
    ("limits", "flat", "words"),
    [
        (MirrorLimits(max_stroke=0.5), np.full(N, 0.6), "max_stroke = 0.5"),
        (MirrorLimits(max_mean=0.1), np.full(N, 0.2), "max_mean = 0.1"),
        (MirrorLimits(max_neighbour=0.1), 0.2 * np.eye(N)[9], "max_neighbour = 0.1"),
        (MirrorLimits(disabled=(9,)), 0.2 * np.eye(N)[9], "actuator 9 is disabled"),
        (MirrorLimits(), np.full(N, np.nan), "not finite"),
        (MirrorLimits(), np.zeros(N + 1), "shape"),
    ],
)
def test_an_illegal_flat_is_refused(limits: MirrorLimits, flat: NDArray[np.float64], words: str) -> None:
    with RecordingMirror(limits=limits) as dm:
        with pytest.raises(CommandRejected, match=words):
            dm.set_flat(flat)
        assert not dm.flat.any()


def test_flat_survives_closing_and_needs_an_open_mirror() -> None:
    dm = RecordingMirror()
    with dm:
        chosen = np.full(N, 0.2)
        dm.set_flat(chosen)
        chosen[:] = 0.9
    assert np.array_equal(dm.history[-1], np.full(N, 0.2))
    for use in (lambda: dm.flat, lambda: dm.shape, dm.flatten, lambda: dm.send(np.zeros(N))):
        with pytest.raises(NotOpen, match=r"mirror: not open; call open\(\)"):
            use()
    with dm:
        assert np.array_equal(dm.flat, np.full(N, 0.2))


def test_two_threads_never_break_the_slew_rule_between_them() -> None:
    class Slow(RecordingMirror):
        def _send(self, command: NDArray[np.float64]) -> None:
            time.sleep(1e-4)
            super()._send(command)

    dm = Slow(limits=MirrorLimits(max_slew=0.01))

    def push(value: float) -> None:
        for _ in range(50):
            dm.send(np.full(N, value))

    with dm:
        threads = [threading.Thread(target=push, args=(value,)) for value in (1.0, -1.0, 0.5)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        assert dm.sent_count == 150 == len(dm.history)
        assert steps(dm.history) <= 0.01 + 1e-9


def test_flattenings_are_counted() -> None:
    with RecordingMirror(limits=MirrorLimits()) as dm:
        before = dm.flatten_count
        dm.send([0.3] * N)
        assert dm.flatten_count == before
        dm.flatten()
        # Flat already: whoever asks begins anew all the same.
        dm.flatten()
        assert dm.flatten_count == before + 2


def test_guard_report_reaches_the_counters() -> None:
    with RecordingMirror(limits=MirrorLimits(max_stroke=0.5)) as dm:
        report = dm.send([0.9] * 5 + [0.0] * (N - 5))
        assert (report.guard.clipped, dm.clipped_count, dm.sent_count) == (5, 5, 1)
        with pytest.raises(CommandRejected):
            dm.send([np.nan] * N)
        assert dm.rejected_count == 1
    dm.open()
    assert (dm.clipped_count, dm.sent_count, dm.rejected_count) == (0, 0, 0)
    dm.close()


@settings(max_examples=40, deadline=None)
@given(st.lists(st.floats(-1.2, 1.2), min_size=N, max_size=N), st.floats(0.05, 1.0))
def test_valid_commands_are_sent_unchanged_and_others_are_not(values: list[float], slew: float) -> None:
    with RecordingMirror("dm", MirrorLimits(max_stroke=0.9, max_slew=slew, max_mean=0.3)) as dm:
        shape = np.array(values)
        is_legal = dm.is_legal(shape)
        assert dm.sent_count == 0
        report = dm.send(shape)
        assert is_legal == report.guard.is_unchanged
        assert not is_legal or np.array_equal(report.sent, shape)


def test_the_compiled_check_is_loaded_before_the_connection(monkeypatch) -> None:
    """A mirror with a watchdog would wait for heartbeats meanwhile."""
    order = []
    monkeypatch.setattr("escape_hw.api.mirror.load_compiled_check", lambda: order.append("check"))

    class Connecting(RecordingMirror):
        def _open(self) -> None:
            order.append("connection")

    Connecting(4).open()
    assert order == ["check", "connection"]
