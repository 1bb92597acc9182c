"""Optimised functions of the loop, each compared with a plain implementation."""

from __future__ import annotations

import math
import os
import threading
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from escape_benchmarks.real_time.ring_camera import POLLS, RingCamera, wait_for_change
from escape_hw.api.camera import CameraInfo, CameraSettings, Region
from escape_hw.errors import DeviceLost, FrameTimeout, SettingRejected
from escape_hw.pipeline.control.integrator import LeakyIntegrator
from escape_hw.pipeline.control.matrix_products import (
    PACKING_BYTES,
    PackedMatrix,
    build_command_mapper,
    zonal_actuators,
)
from escape_hw.safety.guard import CommandGuard
from escape_hw.safety.limits import MirrorLimits, neighbour_pairs
from escape_hw.streams import realtime
from escape_hw.streams.realtime import realtime_thread
from escape_hw.streams.ring import RingReader, RingWriter
from escape_hw.streams.segments import segment_name


# ---------------------------------------------------------------- packed matrices
def test_a_packed_product_is_right_to_a_ten_thousandth():
    rng = np.random.default_rng(1)
    matrix, vector = rng.normal(size=(300, 1001)).astype(np.float32), rng.normal(size=1001).astype(np.float32)
    matrix[7] = 0
    out = np.full(300, np.nan, np.float32)
    packed = PackedMatrix.of(matrix)
    packed.product(vector, out)
    exact = matrix.astype(float) @ vector
    assert np.linalg.norm(out - exact) < 1e-4 * np.linalg.norm(exact)
    assert out[7] == 0
    assert packed.mantissa.nbytes == matrix.nbytes // 2


@pytest.mark.parametrize("bad", [math.nan, math.inf])
def test_what_is_not_finite_stays_so(bad):
    vector = np.ones(64, np.float32)
    vector[40] = bad
    out = np.zeros(3, np.float32)
    PackedMatrix.of(np.ones((3, 64), np.float32)).product(vector, out)
    assert not np.isfinite(out).any()


def near(a, b) -> None:
    np.testing.assert_allclose(a, b, atol=1e-4 * np.abs(b).max())


def test_a_large_integrator_does_what_a_small_one_does():
    rng = np.random.default_rng(2)
    n_modes, n_slopes = 1100, 1000
    matrix = rng.normal(size=(n_modes, n_slopes)).astype(np.float32)
    assert matrix.nbytes > PACKING_BYTES
    large = LeakyIntegrator(matrix, 0.3, 0.02)
    rows = rng.permutation(n_modes)[:50]
    small = LeakyIntegrator(matrix[rows], 0.3, 0.02)
    for _ in range(30):
        slopes = rng.normal(size=n_slopes).astype(np.float32)
        a, b = large(slopes)[rows], small(slopes)
        np.testing.assert_allclose(
            large.residual[rows], small.residual, atol=1e-4 * np.abs(small.residual).max()
        )
    near(a, b)
    large.set_reconstructor(2 * matrix)
    large(slopes)
    small.set_reconstructor(2 * matrix[rows])
    small(slopes)
    near(large.residual[rows], small.residual)


# ---------------------------------------------------------------- shapes
def _orders(n_act: int, n_modes: int) -> np.ndarray:
    rng = np.random.default_rng(3)
    m2c = np.zeros((n_act, n_modes))
    m2c[rng.permutation(n_act)[:n_modes], np.arange(n_modes)] = rng.uniform(0.5, 2, n_modes)
    return m2c


@pytest.mark.parametrize(
    "m2c",
    [
        np.random.default_rng(4).normal(size=(97, 60)),
        np.random.default_rng(5).normal(size=(1100, 1000)),
        np.eye(37),
        _orders(97, 80),
    ],
    ids=["modes", "many modes", "every actuator", "some actuators"],
)
def test_shapes_are_products(m2c):
    shape_of, rng = build_command_mapper(m2c), np.random.default_rng(6)
    for _ in range(3):
        modes = rng.normal(size=m2c.shape[1])
        exact = m2c @ modes
        np.testing.assert_allclose(shape_of(modes), exact, atol=2e-6 * np.abs(exact).max())


def test_only_zonal_modes_are_taken_for_such():
    assert zonal_actuators(np.eye(4)) is not None
    assert zonal_actuators(np.array([[1.0, 1.0], [0.0, 0.0]])) is None
    assert zonal_actuators(np.array([[1.0, 0.0], [1.0, 0.0]])) is None
    assert zonal_actuators(np.zeros((3, 2))) is None


# ---------------------------------------------------------------- limits
@given(
    size=st.sampled_from([0.0, 0.2, 0.79, 0.8, 0.81, 3.0]),
    slew=st.sampled_from([None, 0.3, 1.6]),
    mean=st.sampled_from([None, 0.05, 0.5]),
    neighbour=st.sampled_from([None, 0.2, 1.0]),
    disabled=st.sampled_from([(), (0, 5)]),
    seed=st.integers(0, 1000),
    smooth=st.booleans(),
)
def test_the_compiled_check_agrees_with_the_written_rules(
    size, slew, mean, neighbour, disabled, seed, smooth
):
    rng = np.random.default_rng(seed)
    layout = np.ones((4, 4), bool)
    limits = MirrorLimits(0.8, slew, neighbour, mean, disabled)
    guard = CommandGuard("dm", 16, limits, neighbour_pairs(layout))
    guard.reset(0.1 * rng.uniform(-1, 1, 16) * (np.arange(16) > 5))
    shape = size * (np.full(16, rng.uniform(-1, 1)) if smooth else rng.uniform(-1, 1, 16))
    if disabled and rng.random() < 0.7:
        shape[list(disabled)] = 0
    far = float(np.abs(shape - guard.last).max())
    assert guard.is_legal(shape) == (guard.find_violation(shape) is None and (slew is None or far <= slew))
    safe, report = guard.limit(shape)
    assert report.is_unchanged == guard.is_legal(shape)
    if report.is_unchanged:
        np.testing.assert_array_equal(safe, shape)


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_what_is_no_number_never_obeys(bad):
    guard = CommandGuard("dm", 4, MirrorLimits(1.0))
    shape = np.zeros(4)
    shape[2] = bad
    assert not guard.is_legal(shape)


# ---------------------------------------------------------------- waiting for frames
@pytest.fixture
def ring():
    with RingWriter(segment_name("test.camera", "frames"), 4096, slots=32) as made:
        yield made


def camera_on(ring, rate_hz=100.0, **options) -> RingCamera:
    info = CameraInfo("ring", "1", (4, 6), 16, True)
    return RingCamera("wfs", ring.name, info, CameraSettings(Region(0, 0, 6, 4), 1e-3, rate_hz), **options)


def show(ring, *indices) -> None:
    for index in indices:
        ring.write(np.full((4, 6), index, np.uint16), index, exposed_ns=5)


@pytest.mark.parametrize("spin_s", [0.0, 0.002])
def test_frames_come_in_their_order_and_whole(ring, spin_s):
    with camera_on(ring, spin_s=spin_s) as camera:
        camera.start()

        def produce():
            for index in range(40):
                time.sleep(0.01)
                show(ring, index)

        thread = threading.Thread(target=produce)
        thread.start()
        frames = [camera.next_frame(5.0) for _ in range(40)]
        thread.join()
    assert [frame.index for frame in frames] == list(range(40))
    assert all((frame.data == frame.index).all() for frame in frames)
    assert not frames[0].data.flags.writeable
    assert frames[0].exposed_ns == 5
    assert camera.status().lost == 0


def test_a_late_loop_catches_up_and_a_very_late_one_goes_on_with_the_newest(ring):
    with camera_on(ring) as camera:
        camera.start()
        show(ring, *range(4))
        assert [camera.next_frame(1.0).index for _ in range(4)] == [0, 1, 2, 3]
        show(ring, *range(4, 34))
        assert [camera.next_frame(1.0).index for _ in range(30)] == list(range(4, 34))
        show(ring, *range(34, 65))
        assert camera.next_frame(1.0).index == 64
        assert camera.status().lost == 30


@pytest.mark.parametrize("spin_s", [0.0, 0.002])
def test_no_frame_is_a_time_out_and_no_writer_a_loss(ring, spin_s):
    with camera_on(ring, spin_s=spin_s) as camera:
        show(ring, 0)
        with pytest.raises(FrameTimeout, match=r"no frame within 0\.05 s"):
            camera.next_frame(0.05)
        show(ring, 1)
        assert camera.next_frame(0.05).index == 1
        with pytest.raises(SettingRejected, match="the process that writes the frames"):
            camera.configure(CameraSettings(Region(0, 0, 6, 4), 1e-3, 50.0))
        ring.close()
        with pytest.raises(DeviceLost, match="has ended"):
            camera.next_frame(0.05)


def test_a_sleeping_reader_is_woken(ring):
    with RingReader(ring.name) as reader:
        assert not reader.wait(0, 0.02)
        thread = threading.Timer(0.05, lambda: show(ring, 3))
        thread.start()
        began = time.monotonic()
        assert reader.wait(0, 20.0)
        assert time.monotonic() - began < 10.0
        thread.join()
        assert not reader.wait(1, 0.02)
        assert reader.wait(0, 0.02)


def test_a_spinning_reader_sees_a_change_made_elsewhere():
    word = np.zeros(1, np.uint64)
    assert not wait_for_change(word.ctypes.data, 0, POLLS)
    thread = threading.Timer(0.02, lambda: word.__setitem__(0, 1))
    thread.start()
    # The lock is free meanwhile, or the other thread could never write.
    until = time.monotonic() + 20.0
    while not wait_for_change(word.ctypes.data, 0, 50 * POLLS) and time.monotonic() < until:
        pass
    assert word[0] == 1
    thread.join()


# ---------------------------------------------------------------- the operating system
def test_the_initial_state_is_restored():
    before = os.sched_getscheduler(0), os.sched_getaffinity(0)
    with realtime_thread(cpus=[min(before[1])]) as notes:
        assert os.sched_getaffinity(0) == {min(before[1])} or notes
        if not notes:
            assert os.sched_getscheduler(0) & os.SCHED_FIFO
            policies = []
            thread = threading.Thread(target=lambda: policies.append(os.sched_getscheduler(0)))
            thread.start()
            thread.join()
            assert policies == [os.SCHED_OTHER]
    assert (os.sched_getscheduler(0), os.sched_getaffinity(0)) == before


def test_what_is_not_allowed_is_said_and_the_loop_runs_all_the_same(monkeypatch):
    def refuse(*_):
        raise PermissionError(1, "Operation not permitted")

    monkeypatch.setattr(realtime.os, "sched_setscheduler", refuse)
    monkeypatch.setattr(realtime.os, "sched_setaffinity", refuse)
    with realtime_thread(cpus=[0]) as notes:
        assert len(notes) >= 2
        assert "processor affinity refused" in notes[0]
        assert "no real-time priority" in notes[1]
