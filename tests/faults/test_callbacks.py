"""Callbacks on a running bench receive the data that pass, and their failures do not affect it."""

from __future__ import annotations

import numpy as np
from small_bench import assert_flat, small

from escape_hw.api.callbacks import Callbacks
from escape_hw.calibration.acquisition.sensor_setup import build_slope_function
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.runner import RunningLoop


class Seen:
    """Copies the arguments of every callback."""

    def __init__(self) -> None:
        self.frames, self.images, self.slopes, self.commands, self.residuals = [], [], [], [], []

    def callbacks(self) -> Callbacks:
        return Callbacks(
            frame=self.frames.append,
            science=self.images.append,
            slopes=lambda index, slopes: self.slopes.append((index, slopes.copy())),
            command=lambda shape: self.commands.append(shape.copy()),
            residual=lambda index, modes, rms: self.residuals.append((index, modes.copy(), rms)),
        )


def closed(bench, good, frames=60):
    """Close the loop for some frames; what an observer sees of it."""
    control = build_integrator(bench, good.matrix, good.grid)
    loop = RunningLoop(bench, good.matrix.m2c, build_slope_function(bench, good.grid), control, science=True)
    seen = []
    try:
        bench.run(loop.run(frames, observe=(lambda *row: seen.append([np.array(v) for v in row]),)))
    finally:
        bench.dm.flatten()
    assert_flat(bench)
    return loop, seen


def test_callbacks_receive_what_passes(bench, good):
    look = Seen()
    bench.callbacks = look.callbacks()
    loop, seen = closed(bench, good, 300)
    indices = [int(row[0]) for row in seen]
    assert [frame.index for frame in look.frames] == indices
    assert [index for index, _ in look.slopes] == indices
    np.testing.assert_array_equal([s for _, s in look.slopes], [row[1] for row in seen])
    # The ramp to flat comes after the loop's commands.
    np.testing.assert_allclose(look.commands[:300], [good.matrix.m2c @ row[2] for row in seen], atol=1e-12)
    assert not look.commands[-1].any()
    assert len(look.commands) > 300
    assert [index for index, _, _ in look.residuals] == indices
    rms = [np.linalg.norm(modes) for _, modes, _ in look.residuals]
    np.testing.assert_allclose(rms, [value for *_, value in look.residuals], rtol=1e-5)
    np.testing.assert_allclose(rms, np.array(loop.record.residual), rtol=1e-5)
    assert len(look.images) >= loop.record.science.count > 0


def test_no_callback_unless_set(bench, good):
    assert bench.callbacks == Callbacks()
    assert (bench.wfs.callback, bench.dm.callback, bench.science.callback) == (None, None, None)
    assert type(build_slope_function(bench, good.grid)).__name__ == "ShackHartmannSlopes"
    bench.callbacks = Seen().callbacks()
    bench.callbacks = Callbacks()
    assert (bench.wfs.callback, bench.dm.callback, bench.science.callback) == (None, None, None)


def test_a_callback_that_fails_is_dropped_and_the_loop_continues(bench, good, caplog):
    calls = []

    def failing(*row):
        calls.append(row)
        raise ValueError("the screen is gone")

    bench.callbacks = Callbacks(failing, failing, failing, failing, failing)
    loop, seen = closed(bench, good)
    assert len(seen) == loop.record.frames == 60
    told = [record.message for record in caplog.records if "is disabled" in record.message]
    assert told == [f"the callback for {name} failed and is disabled" for name in
                    ("frames", "slopes", "commands", "residuals")]  # fmt: skip
    assert len(calls) == 4


def test_a_run_ends_with_the_same_numbers_with_and_without_observers(good):
    commands = []
    for look in (False, True):
        with small("twin.loss_probability=0") as bench:
            if look:
                bench.callbacks = Seen().callbacks()
            closed(bench, good)
            commands.append(bench.dm.sent_count)
            _, seen = closed(bench, good)
            commands.append(np.stack([row[2] for row in seen]))
    assert commands[0] == commands[2]
    np.testing.assert_array_equal(commands[1], commands[3])
