"""Wrappers that inject faults: they inject the given faults and nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.api.camera import FrameStatus
from escape_hw.errors import DeviceError, DeviceLost, FrameTimeout
from escape_hw.safety.limits import MirrorLimits
from escape_hw.testing import FaultyCamera, FaultyMirror
from escape_hw.testing.reference_devices import RecordingMirror, SyntheticCamera


def indices(camera: FaultyCamera, n: int) -> list[int]:
    return [camera.next_frame().index for _ in range(n)]


def test_camera_without_faults_passes_everything() -> None:
    with FaultyCamera(SyntheticCamera()) as camera:
        assert indices(camera, 5) == [1, 2, 3, 4, 5]
        assert camera.status() == FrameStatus(delivered=5)


def test_dropped_frames_are_gaps_and_counted_as_lost() -> None:
    with FaultyCamera(SyntheticCamera(), drop={2, 3, 6}) as camera:
        assert indices(camera, 4) == [1, 4, 5, 7]
        assert camera.status() == FrameStatus(delivered=4, lost=3)


def test_every_nth_frame_can_be_dropped() -> None:
    with FaultyCamera(SyntheticCamera(), drop_every=3) as camera:
        assert indices(camera, 6) == [1, 2, 4, 5, 7, 8]
    with pytest.raises(ValueError, match="drop_every is 1"):
        FaultyCamera(SyntheticCamera(), drop_every=1)


def test_a_stalled_camera_times_out_on_its_own_clock_every_time() -> None:
    with FaultyCamera(SyntheticCamera(), stall_from=3) as camera:
        assert indices(camera, 2) == [1, 2]
        for n in range(1, 4):
            before = camera.now_ns()
            with pytest.raises(FrameTimeout, match="camera: "):
                camera.next_frame(0.05)
            assert camera.now_ns() - before >= 0.05e9
            assert camera.status().timeouts == n


def test_a_drop_within_the_deadline_is_waited_out_but_not_beyond_it() -> None:
    with FaultyCamera(SyntheticCamera(), drop={2}) as camera:
        period = 1 / camera.settings.frame_rate_hz
        camera.next_frame()
        with pytest.raises(FrameTimeout):
            camera.next_frame(1.5 * period)
        assert camera.next_frame().index == 3


def test_a_repeated_frame_is_delivered_twice_and_refused_once() -> None:
    with FaultyCamera(SyntheticCamera(), repeat={2}) as camera:
        assert indices(camera, 2) == [1, 2]
        with pytest.raises(DeviceError, match="frame index went from 2 to 2"):
            camera.next_frame()
        assert camera.next_frame().index == 3
        assert camera.status() == FrameStatus(delivered=3)


def test_a_lost_camera_stays_lost_but_closes() -> None:
    inner = SyntheticCamera()
    with FaultyCamera(inner, lost_from=3) as camera:
        indices(camera, 2)
        for _ in range(2):
            with pytest.raises(DeviceLost, match="lost at frame"):
                camera.next_frame()
    assert not inner.is_open


def test_mirror_records_what_reached_the_inner_one() -> None:
    inner = RecordingMirror(limits=MirrorLimits(max_stroke=0.5))
    with FaultyMirror(inner) as dm:
        dm.send(np.full(21, 0.9))
        dm.send(np.full(21, 0.1))
        assert len(dm.reached) == 2
    np.testing.assert_array_equal(dm.reached[:2], [np.full(21, 0.5), np.full(21, 0.1)])
    np.testing.assert_array_equal(inner.history, dm.reached)
    assert not dm.reached[-1].any()


def test_one_transfer_can_fail_and_the_next_pass() -> None:
    with FaultyMirror(RecordingMirror(), fail_sends={1}) as dm:
        dm.send(np.full(21, 0.1))
        with pytest.raises(DeviceError, match="mirror: transfer 1 failed"):
            dm.send(np.full(21, 0.2))
        np.testing.assert_array_equal(dm.shape, np.full(21, 0.1))
        dm.send(np.full(21, 0.3))
    assert [float(shape[0]) for shape in dm.reached[:2]] == [0.1, 0.3]


def test_a_lost_mirror_takes_nothing_more_and_is_reported_on_closing() -> None:
    inner = RecordingMirror()
    dm = FaultyMirror(inner, lost_from=1)
    dm.open()
    dm.send(np.full(21, 0.1))
    for _ in range(2):
        with pytest.raises(DeviceLost):
            dm.send(np.full(21, 0.2))
    with pytest.raises(DeviceLost):
        dm.close()
    assert len(dm.reached) == 1
    assert not dm.is_open
    assert not inner.is_open


def test_wrapping_an_open_mirror_takes_over_its_shape_and_flat() -> None:
    inner = RecordingMirror(limits=MirrorLimits(max_slew=0.1)).open()
    inner.set_flat(np.full(21, 0.05))
    inner.send(np.full(21, 0.1))
    with FaultyMirror(inner) as dm:
        np.testing.assert_array_equal(dm.shape, np.full(21, 0.1))
        np.testing.assert_array_equal(dm.flat, np.full(21, 0.05))
        np.testing.assert_allclose(dm.send(np.full(21, 0.9)).sent, 0.2)
    np.testing.assert_array_equal(inner.history[-1], np.full(21, 0.05))


def test_a_failed_opening_closes_the_inner_device() -> None:
    class Half(RecordingMirror):
        @property
        def flat(self) -> np.ndarray:
            raise DeviceError(self.name, "does not answer")

    inner = Half()
    with pytest.raises(DeviceError, match="does not answer"):
        FaultyMirror(inner).open()
    assert not inner.is_open
