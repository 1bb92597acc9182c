"""The loop that stays closed until it is opened: changes without a transient, and automatic opening."""

from __future__ import annotations

from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
from small_bench import assert_flat, faulty

from escape_hw.calibration.docrime.closed_loop import docrime_closed_loop
from escape_hw.calibration.loop import operation as endless_loop
from escape_hw.calibration.loop.control import LoopControl
from escape_hw.calibration.loop.operation import run_until_opened
from escape_hw.errors import Aborted, ConfigError, DeviceLost, FrameTimeout, IncompatibleProduct
from escape_hw.pipeline.statistics import MIN_SAMPLES
from escape_hw.streams.timing import BINS


class Operator:
    """Does things at certain frames, and opens the loop in the end."""

    def __init__(self, bench, loop_control, *steps, end=600):
        self.bench, self.loop_control, self.steps, self.end = bench, loop_control, list(steps), end
        self.metrics, self.arrays, self.shapes = [], {}, []

    def __call__(self, progress):
        assert progress.stage == "closed loop"
        self.metrics.append(dict(progress.metrics))
        self.arrays |= progress.arrays
        while self.steps and progress.done >= self.steps[0][0]:
            self.steps.pop(0)[1](self.loop_control)
        if progress.done >= self.end:
            self.loop_control.request_open()


@pytest.fixture(autouse=True)
def _often(monkeypatch):
    """Progress after every frame."""
    monkeypatch.setattr("escape_hw.api.procedure.Reporter.PERIOD_S", 0.0)


def kept(bench, good, *steps, end=600, psf=None, **settings):
    """Run the loop; its end, what the operator saw, and all that the mirror got."""
    loop_control = LoopControl(bench, good.run.result, **settings)
    operator, sent = Operator(bench, loop_control, *steps, end=end), []
    bench.dm.callback = lambda shape: sent.append(shape.copy())
    found = bench.run(run_until_opened(bench, loop_control, model_psf=psf), observers=(operator,))
    assert_flat(bench)
    return found, operator, np.array(sent)


def largest_step(sent):
    return np.abs(np.diff(sent[:-20], axis=0)).max(axis=1)


def test_it_stays_closed_until_opened_and_reports_its_state(bench, good):
    found, operator, _ = kept(bench, good, psf=good.psf, end=1500)
    assert found.fault == ""
    assert 1500 <= found.frames < 1500 + 60
    assert found.settings.gain == bench.config.loop.gain
    assert found.timing.p50 > 0
    last = operator.metrics[-1]
    assert last["latency_p50"] <= last["latency_p99"] <= last["latency_max"]
    assert last["gain"] == bench.config.loop.gain
    assert 0 <= last["clipped"] < 0.2
    assert last["lost"] == 0
    residual = [metrics["residual_nm"] for metrics in operator.metrics]
    assert np.median(residual[-300:]) < 0.5 * max(residual[:10])
    assert operator.arrays["latency_histogram"].shape == (2, BINS)
    assert operator.arrays["residual"].shape == (500,)


def test_the_strehl_ratio_is_followed(bench, good):
    rate = bench.config.devices.wfs.frame_rate_hz / bench.config.devices.science.frame_rate_hz
    found, operator, _ = kept(bench, good, psf=good.psf, end=int(4 * MIN_SAMPLES * rate) + 400)
    ratios = [m["strehl"] for m in operator.metrics if np.isfinite(m.get("strehl", np.nan))]
    assert ratios
    assert 0.3 < ratios[-1] < 1.05
    assert found.fault == ""


def test_settings_change_without_a_transient(bench, good):
    other = replace(good.run.result, matrix=replace(good.matrix, data=good.matrix.data * 1.02))
    steps = (
        (400, lambda loop_control: loop_control.request_change(gain=0.2)),
        (600, lambda loop_control: loop_control.request_change(leak=0.05)),
        (800, lambda loop_control: loop_control.request_change(calibration=other, gain=0.3)),
    )
    found, operator, sent = kept(bench, good, *steps, end=1000)
    assert found.settings.calibration is other
    assert (found.settings.gain, found.settings.leak) == (0.3, 0.05)
    assert operator.metrics[-1]["gain"] == 0.3
    steps_of = largest_step(sent)
    # No command departs further from the one before than those of an undisturbed loop do.
    assert steps_of[380:].max() < 1.5 * steps_of[150:380].max()


def test_dropped_modes_fade_from_the_mirror(bench, good):
    found, _, sent = kept(
        bench,
        good,
        (500, lambda loop_control: loop_control.request_change(dropped_modes=12)),
        end=1000,
        leak=0.0,
        gain=0.3,
    )
    assert found.fault == ""
    steps_of = largest_step(sent)
    assert steps_of[480:].max() < 1.5 * steps_of[150:480].max()
    # What twelve eigenmodes span is empty in the end, also without a leak.
    control = LoopControl(bench, good.run.result, dropped_modes=12).take_change()
    modes = np.linalg.lstsq(good.matrix.m2c, sent[-40 - 20], rcond=None)[0]
    before = np.linalg.lstsq(good.matrix.m2c, sent[480], rcond=None)[0]
    idle = control.undriven.T
    assert idle.shape[0] == 12
    assert np.linalg.norm(idle @ modes) < 0.02 * np.linalg.norm(idle @ before)
    assert np.linalg.norm(modes) > 0.3 * np.linalg.norm(before)


def test_what_makes_no_sense_is_refused_and_changes_nothing(bench, good):
    loop_control = LoopControl(bench, good.run.result)
    first = loop_control.take_change()
    with pytest.raises(ConfigError, match="gain is -1"):
        loop_control.request_change(gain=-1)
    with pytest.raises(ConfigError, match="leak 2"):
        loop_control.request_change(leak=2.0)
    fewer = replace(good.matrix, data=good.matrix.data[:, :9], sigma=good.matrix.sigma[:, :9],
                    m2c=good.matrix.m2c[:, :9])  # fmt: skip
    with pytest.raises(ConfigError, match="open the loop"):
        loop_control.request_change(calibration=replace(good.run.result, matrix=fewer))
    assert loop_control.take_change() is None
    assert loop_control.settings == first.settings
    with pytest.raises(IncompatibleProduct):
        LoopControl(bench, replace(good.run.result, matrix=replace(good.matrix, m2c=good.matrix.m2c[:9])))


@pytest.mark.parametrize("sign", [-1.0])
def test_a_loop_of_the_wrong_sign_is_opened(bench, good, sign):
    wrong = replace(good.run.result, matrix=replace(good.matrix, data=sign * good.matrix.data))
    loop_control = LoopControl(bench, wrong)
    operator = Operator(bench, loop_control, end=100_000)
    found = bench.run(run_until_opened(bench, loop_control), observers=(operator,))
    assert_flat(bench)
    assert "lower the gain" in found.fault
    assert found.frames < 2000


def test_a_loop_that_loses_its_light_is_opened(bench, good):
    def dark(loop_control):
        bench.screen.set(blocked=True)

    found, _, _ = kept(bench, good, (300, dark), end=100_000)
    assert "no light" in found.fault
    assert found.frames < 400


def test_a_camera_that_stalls_opens_it(good):
    with faulty("twin.loss_probability=0", wfs={"stall_from": 100}) as bench:
        found, _, _ = kept(bench, good, end=100_000)
        assert "no frame for 5 time-outs in a row" in found.fault
        assert found.failed_device == bench.wfs.name
        assert found.timeouts == 5
        assert found.frames < 110


def test_fewer_time_outs_in_a_row_do_not(bench, good, monkeypatch):
    deliver, calls = bench.wfs._next_frame, iter(range(10_000))

    def halting(timeout_s):
        if next(calls) % 100 < 4:
            raise FrameTimeout(bench.wfs.name, "no frame, as arranged")
        return deliver(timeout_s)

    monkeypatch.setattr(bench.wfs, "_next_frame", halting)
    # The first frame, before the loop closes, must come.
    next(calls), next(calls), next(calls), next(calls)
    found, _, _ = kept(bench, good, end=600)
    assert found.fault == ""
    assert found.timeouts >= 4 * 5


def test_a_lost_mirror_is_an_error(good):
    with pytest.raises(DeviceLost), faulty("twin.loss_probability=0", dm={"lost_from": 200}) as bench:
        kept(bench, good, end=100_000)


def test_an_abort_opens_it(bench, good):
    from threading import Event

    loop_control, abort = LoopControl(bench, good.run.result), Event()

    def stop(progress):
        if progress.done > 100:
            abort.set()

    with pytest.raises(Aborted) as caught:
        bench.run(run_until_opened(bench, loop_control), observers=(stop,), abort=abort)
    assert_flat(bench)
    assert caught.value.partial.fault == ""
    assert caught.value.partial.frames > 100


@pytest.mark.slow
def test_a_measurement_continues_from_the_loops_own_matrix(bench, good):
    loop_control = LoopControl(bench, good.run.result)
    found = bench.run(
        run_until_opened(bench, loop_control), observers=(Operator(bench, loop_control, end=300),)
    )
    result = bench.run(docrime_closed_loop(bench, found.settings.calibration, frames=1200, poke=0.01))
    assert_flat(bench)
    assert result.grid.n_valid == good.grid.n_valid
    assert np.array_equal(result.matrix.m2c, good.matrix.m2c)


def test_a_real_loop_requests_priority_and_reports_what_was_refused(bench, good, monkeypatch, caplog):
    asked = []

    @contextmanager
    def refusing(cpus=None, priority=1):
        asked.append(priority)
        yield ("no real-time priority: Operation not permitted",) if priority else ()
        asked.append("out")

    monkeypatch.setattr(endless_loop, "realtime_thread", refusing)
    kept(bench, good, end=30)
    assert asked == [0, "out"]
    asked.clear()
    monkeypatch.setattr(type(bench), "simulated", False)
    found = bench.run(run_until_opened(bench, loop_control := LoopControl(bench, good.run.result)),
                      observers=(Operator(bench, loop_control, end=30),))  # fmt: skip
    assert found.fault == ""
    assert asked == [1, "out"]
    assert "frames may be answered late: no real-time priority" in caplog.text
