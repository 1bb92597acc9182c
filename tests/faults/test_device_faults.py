"""A device that fails during a run: a typed error that names it, and a flat mirror."""

from __future__ import annotations

import numpy as np
import pytest
from small_bench import assert_flat, faulty, settled_shape

from escape_hw.calibration.acquisition.model_psf import measure_model_psf
from escape_hw.calibration.acquisition.sensor_setup import find_sensor, measure_dark
from escape_hw.calibration.docrime.open_loop import docrime
from escape_hw.calibration.escape.method import escape
from escape_hw.calibration.loop.gain_search import find_best_gain
from escape_hw.calibration.loop.performance import close_loop
from escape_hw.calibration.push_pull.procedure import push_pull
from escape_hw.errors import DeviceError, DeviceLost, FrameTimeout
from escape_hw.runtime.session.record import without_turbulence


def calm_push_pull(bench, good):
    with without_turbulence(bench):
        return (yield from push_pull(bench, frames=3))


PROCEDURES = {
    "find_sensor": lambda bench, good: find_sensor(bench),
    "measure_dark": lambda bench, good: measure_dark(bench),
    "push_pull": calm_push_pull,
    "docrime": lambda bench, good: docrime(bench, frames=400),
    "docrime on a known grid": lambda bench, good: docrime(bench, frames=400, grid=good.grid),
    "escape": lambda bench, good: escape(bench, frames=400),
    "closed_loop": lambda bench, good: close_loop(bench, good.matrix, good.grid, frames=300),
    "best_gain": lambda bench, good: find_best_gain(bench, good.matrix, good.grid, frames=200),
}
MOVING = [name for name in PROCEDURES if name not in ("find_sensor", "measure_dark")]


def scene(bench):
    state = bench.screen.state
    return state.inserted, state.blocked


@pytest.mark.parametrize("name", PROCEDURES)
@pytest.mark.parametrize("frame", [0, 90])
def test_a_failed_camera(good, name, frame):
    with faulty(wfs={"stall_from": frame}) as bench:
        before = bench.wfs.now_ns()
        with pytest.raises(FrameTimeout, match=r"^wfs: no frame within 1 s") as caught:
            bench.run(PROCEDURES[name](bench, good))
        assert caught.value.exit_code == 3
        # Up to 90 frames at 500 Hz and the configured time-out, by the bench's own clock.
        assert 1e9 <= bench.wfs.now_ns() - before < 2e9
        assert bench.wfs.status().timeouts == 1
        assert_flat(bench)
        assert scene(bench) == (True, False)


@pytest.mark.parametrize("name", PROCEDURES)
def test_a_lost_camera(good, name):
    with faulty(wfs={"lost_from": 90}) as bench:
        with pytest.raises(DeviceLost, match=r"^wfs: lost at frame 90"):
            bench.run(PROCEDURES[name](bench, good))
        assert_flat(bench)
        assert scene(bench) == (True, False)


@pytest.mark.parametrize("name", MOVING)
def test_a_transfer_that_fails_once(good, name):
    with faulty(dm={"fail_sends": [15]}) as bench:
        with pytest.raises(DeviceError, match=r"^dm: transfer 15 failed"):
            bench.run(PROCEDURES[name](bench, good))
        assert bench.dm.transfers > 16
        assert_flat(bench)


@pytest.mark.parametrize("name", MOVING)
def test_a_lost_mirror_keeps_its_last_shape_and_this_is_reported(good, name):
    bench = faulty(dm={"lost_from": 15}).open()
    with pytest.raises(DeviceLost, match=r"^dm: lost"):
        bench.run(PROCEDURES[name](bench, good))
    # Nobody can flatten it; the book says what it has, not what was wished for.
    np.testing.assert_array_equal(settled_shape(bench), bench.dm.shape)
    assert bench.dm.shape.any()
    assert scene(bench) == (True, False)
    with pytest.raises(DeviceLost, match=r"^dm: lost"):
        bench.close()
    assert not any(device.is_open for device in bench.devices)


@pytest.mark.parametrize("fault", ["stall_from", "lost_from"])
def test_a_science_camera_that_fails_while_the_model_psf_is_taken(fault):
    with faulty(science={fault: 5}) as bench:
        with pytest.raises(DeviceError, match=r"^science: "):
            bench.run(measure_model_psf(bench))
        assert_flat(bench)


def test_a_science_camera_lost_under_the_loop_opens_it(good):
    with faulty(science={"lost_from": 3}) as bench:
        loop = close_loop(bench, good.matrix, good.grid, frames=400, model_psf=good.psf)
        with pytest.raises(DeviceLost, match=r"^science: "):
            bench.run(loop)
        assert_flat(bench)


def test_a_science_camera_that_stalls_under_the_loop_is_reported(good):
    with faulty(science={"stall_from": 5}) as bench:
        result = bench.run(close_loop(bench, good.matrix, good.grid, frames=1000, model_psf=good.psf))
        assert result.stable
        assert any("frames came from science" in note for note in result.notes), result.notes
        assert_flat(bench)
    with faulty() as bench:
        result = bench.run(close_loop(bench, good.matrix, good.grid, frames=1000, model_psf=good.psf))
        assert result.notes == ()
        assert result.strehl is not None


def test_a_frame_delivered_twice_is_refused_and_the_mirror_flat(good):
    with faulty(wfs={"repeat": [150]}) as bench:
        with pytest.raises(DeviceError, match="index went from 150 to 150"):
            bench.run(docrime(bench, frames=400))
        assert_flat(bench)


def test_the_bench_works_again_after_a_fault(good):
    with faulty(wfs={"stall_from": 90}) as bench:
        with pytest.raises(FrameTimeout):
            bench.run(docrime(bench, frames=400))
        bench.wfs.stall_from = None
        result = bench.run(docrime(bench, frames=400))
        assert not result.partial
        assert result.matrix.snr().min() > 10
