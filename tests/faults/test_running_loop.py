"""The loop frame by frame: pokes added to the controller's command, clipping, and exchange of the matrix."""

from __future__ import annotations

import numpy as np
from small_bench import assert_flat, small

from escape_hw.calibration.acquisition.sensor_setup import build_slope_function
from escape_hw.calibration.loop.control import build_integrator
from escape_hw.calibration.loop.runner import RunningLoop
from escape_hw.pipeline.control.reconstructor import reconstructor


class Watch:
    """Keeps what an observer sees, and the controller's state at that moment."""

    def __init__(self, bench, control):
        self.bench, self.control, self.seen = bench, control, []

    def __call__(self, index, slopes, command, poke):
        row = index, slopes, command, poke, self.control.state, self.bench.dm.shape
        self.seen.append([np.array(value) for value in row])

    def columns(self):
        return [np.stack(column) for column in zip(*self.seen, strict=True)]


def pokes(bench, n_modes, amplitude):
    return lambda: amplitude * bench.rng.uniform(-1, 1, n_modes)


def run(bench, good, *stretches, gain=0.3):
    """Run stretches of a loop, ``(frames, poke amplitude, what to do before)`` each."""
    control = build_integrator(bench, good.matrix, good.grid, gain=gain)
    loop = RunningLoop(bench, good.matrix.m2c, build_slope_function(bench, good.grid), control)
    watch = Watch(bench, control)
    try:
        for frames, amplitude, before in stretches:
            if before is not None:
                before(loop)
            inject = pokes(bench, good.matrix.n_modes, amplitude) if amplitude else None
            bench.run(loop.run(frames, inject=inject, observe=(watch,)))
    finally:
        bench.dm.flatten()
    assert_flat(bench)
    return loop, watch


def test_observers_see_the_total_command_and_the_poke_in_it(bench, good):
    _, watch = run(bench, good, (100, 0.01, None))
    index, slopes, command, poke, state, shape = watch.columns()
    assert (np.diff(index) == 1).all()
    assert slopes.dtype == np.float32
    assert command.dtype == poke.dtype == np.float64
    assert np.abs(poke).max() <= 0.01
    assert np.abs(poke).max() > 0.009
    # The poke stands beside the integrator: its state is the rest of the command.
    np.testing.assert_allclose(command, state + poke, atol=1e-12)
    np.testing.assert_allclose(shape, command @ good.matrix.m2c.T, atol=1e-12)


def test_without_injection_the_poke_is_zero(bench, good):
    _, watch = run(bench, good, (30, 0.0, None))
    _, _, command, poke, state, _ = watch.columns()
    assert not poke.any()
    np.testing.assert_array_equal(command, state.astype(float))


def test_a_command_beyond_the_limits_stays_a_command_of_the_modes(good):
    with small("twin.loss_probability=0", "devices.dm.limits.max_stroke=0.05") as bench:
        loop, watch = run(bench, good, (200, 0.02, None))
        _, _, command, poke, state, shape = watch.columns()
        assert loop.record.shortened > 20
        assert np.abs(shape).max() <= 0.05 + 1e-9
        np.testing.assert_allclose(shape, command @ good.matrix.m2c.T, atol=1e-9)
        # The controller hears what the mirror took of its own part.
        np.testing.assert_allclose(state, command - poke, atol=1e-6)


def test_stretches_without_opening_and_exchange_between_them(bench, good):
    other = reconstructor(good.matrix.data, dropped_modes=12)
    loop, watch = run(
        bench, good,
        (150, 0.0, None),
        (50, 0.01, None),
        (100, 0.0, lambda loop: loop.control.set_reconstructor(other)),
        (100, 0.0, lambda loop: loop.control.set_gain(np.full(good.matrix.n_modes, 0.2))),
    )  # fmt: skip
    index, *_, state, _ = watch.columns()
    assert loop.record.frames == len(loop.record.residual) == len(loop.record.latency) == 400
    assert (np.diff(index) == 1).all()
    steps = np.linalg.norm(np.diff(state, axis=0), axis=1)
    # No bump: the step at either exchange is like those before it.
    for at in (200, 300):
        assert steps[at - 1] < 3 * np.median(steps[at - 31 : at - 1])
    residual = np.array(loop.record.residual)
    assert residual[100:150].mean() < 0.5 * residual[:3].mean()
    assert residual[250:].mean() < 0.5 * residual[:3].mean()


def test_a_loop_at_its_limits_stops(good):
    with small("twin.loss_probability=0", "devices.dm.limits.max_stroke=0.002") as bench:
        for amplitude in (0.0, 0.001):
            loop, _ = run(bench, good, (400, amplitude, None), gain=0.9)
            assert loop.record.diverged
            assert 50 <= loop.record.frames < 400
