"""The leaky integrator, and the stability limit of the gain with delay."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.pipeline.control.integrator import LeakyIntegrator, gain_limit

ONE = np.ones((1, 1), np.float32)


def run_loop(gain, delay, leak=0.0, frames=3000, disturbance=1.0, limit=np.inf, windup=False):
    """Residuals of one mode: slopes show the command sent ``delay`` frames before."""
    control = LeakyIntegrator(ONE, gain, leak)
    sent = [0.0] * delay
    residuals = np.empty(frames)
    for k in range(frames):
        level = disturbance(k) if callable(disturbance) else disturbance
        residuals[k] = level + sent[-delay]
        command = float(control(np.array([residuals[k]], np.float32))[0])
        clipped = float(np.clip(command, -limit, limit))
        if clipped != command and not windup:
            control.set_applied(np.array([clipped]))
        sent.append(clipped)
    return residuals


@pytest.mark.parametrize("delay", [1, 2, 3, 4])
def test_the_limit_separates_stable_from_diverging(delay):
    limit = gain_limit(delay)
    below = np.abs(run_loop(0.98 * limit, delay))
    above = np.abs(run_loop(1.02 * limit, delay, frames=1500))
    assert below[-50:].max() < 1e-3 * below[:50].max()
    assert above[-50:].max() > 100 * above[:50].max()


def test_known_limits():
    assert gain_limit(1) == pytest.approx(2.0)
    assert gain_limit(2) == pytest.approx(1.0)
    # The golden ratio: z^3 - z^2 + g = 0 on the unit circle.
    assert gain_limit(3) == pytest.approx((np.sqrt(5) - 1) / 2)
    assert gain_limit(0.3) == gain_limit(1)
    delays = np.linspace(1, 5, 50)
    assert (np.diff([gain_limit(d) for d in delays]) < 0).all()


@pytest.mark.parametrize("gain", [0.1, 0.425, 0.9])
def test_step_response_is_geometric_at_one_frame_of_delay(gain):
    residuals = run_loop(gain, 1, frames=20)
    assert residuals == pytest.approx((1 - gain) ** np.arange(20), abs=1e-6)


def test_without_leak_a_constant_is_taken_out_entirely():
    assert abs(run_loop(0.4, 2)[-1]) < 1e-6


@pytest.mark.parametrize(("gain", "leak"), [(0.425, 0.026), (0.3, 0.1)])
def test_a_leak_leaves_its_share(gain, leak):
    # Steady state: leak * c = -gain * r with r = 1 + c.
    assert run_loop(gain, 2, leak)[-1] == pytest.approx(leak / (leak + gain), abs=1e-5)


def test_the_leak_lets_the_state_decay():
    control = LeakyIntegrator(ONE, 0.5, 0.1)
    control.set_applied(np.array([1.0]))
    states = [float(control(np.zeros(1, np.float32))[0]) for _ in range(10)]
    assert states == pytest.approx(0.9 ** np.arange(1, 11), rel=1e-5)


def test_what_was_really_applied_prevents_wind_up():
    # A disturbance beyond the mirror's reach for 300 frames, then none.
    def pulse(k):
        return 5.0 if k < 300 else 0.0

    recovered = [
        int(np.flatnonzero(np.abs(r[300:]) > 0.05)[-1])
        for r in (
            run_loop(0.4, 2, frames=2000, disturbance=pulse, limit=1.0, windup=w) for w in (False, True)
        )
    ]
    assert recovered[0] < 30
    assert recovered[1] > 300


def test_the_command_is_minus_gain_times_reconstructed_slopes():
    rng = np.random.default_rng(0)
    r = rng.normal(size=(5, 14)).astype(np.float32)
    control = LeakyIntegrator(r, 0.3, 0.05)
    want = np.zeros(5)
    for _ in range(50):
        slopes = rng.normal(size=14).astype(np.float32)
        got = control(slopes)
        want = 0.95 * want - 0.3 * (r @ slopes)
        assert got == pytest.approx(want, abs=1e-4)
        assert control.residual == pytest.approx(r @ slopes, abs=1e-4)
    control.reset()
    assert not control.state.any()


def test_results_are_updated_in_place():
    # The loop allocates nothing per frame; whoever keeps a command copies it.
    control = LeakyIntegrator(ONE, 0.5, 0.0)
    first = control(np.ones(1, np.float32))
    assert control(np.ones(1, np.float32)) is first
    assert first[0] == np.float32(-1.0)
    assert control.residual[0] == 1


def test_it_continues_from_what_the_mirror_really_did():
    r = np.random.default_rng(1).standard_normal((7, 20)).astype(np.float32)
    control, slopes = LeakyIntegrator(r, 0.4, 0.1), np.ones(20, np.float32)
    control(slopes)
    control.set_applied(np.arange(7.0))
    assert control(slopes) == pytest.approx(0.9 * np.arange(7) - 0.4 * (r @ slopes), abs=1e-5)


def test_applied_does_not_hold_on_to_the_callers_array():
    control = LeakyIntegrator(ONE, 0.5, 0.0)
    modes = np.ones(1, np.float32)
    control.set_applied(modes)
    modes[0] = 77
    assert control(np.zeros(1, np.float32))[0] == 1


def test_modes_have_gains_of_their_own():
    gains = np.array([0.1, 0.4, 0.9])
    control = LeakyIntegrator(np.eye(3, dtype=np.float32), gains, 0.0)
    assert control(np.ones(3, np.float32)) == pytest.approx(-gains)
    control.set_gain(0.5)
    assert control(np.ones(3, np.float32)) == pytest.approx(-gains - 0.5)
    with pytest.raises(ValueError, match="shape"):
        control.set_gain(np.ones(2))
    with pytest.raises(ValueError, match="positive"):
        control.set_gain(np.array([0.1, 0.0, 0.2]))


def test_another_reconstructor_comes_without_a_transient():
    rng = np.random.default_rng(3)
    old, new = rng.standard_normal((2, 5, 12)).astype(np.float32)
    control, slopes = LeakyIntegrator(old, 0.4, 0.1), rng.standard_normal(12).astype(np.float32)
    before = control(slopes).copy()
    control.set_reconstructor(new)
    new_at_exchange = new.copy()
    new[:] = 0
    assert control.state == pytest.approx(before)
    assert control(slopes) == pytest.approx(0.9 * before - 0.4 * (new_at_exchange @ slopes), abs=1e-5)
    with pytest.raises(ValueError, match="another basis or grid"):
        control.set_reconstructor(new[:4])


@pytest.mark.parametrize(("gain", "leak"), [(0.0, 0.0), (-1.0, 0.0), (0.4, -0.1), (0.4, 1.1), (np.nan, 0.0)])
def test_senseless_parameters_are_refused(gain, leak):
    with pytest.raises(ValueError, match=r"gain|leak"):
        LeakyIntegrator(ONE, gain, leak)
