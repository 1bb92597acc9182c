"""The leaky integrator."""

from __future__ import annotations

import numpy as np
import pytest

from escape_hw.pipeline.integrator import LeakyIntegrator, gain_limit


@pytest.fixture
def matrix():
    return np.random.default_rng(0).standard_normal((7, 20)).astype(np.float32)


def test_a_step_is_the_papers(matrix):
    rng = np.random.default_rng(1)
    control, want = LeakyIntegrator(matrix, 0.4, 0.03), np.zeros(7)
    for _ in range(50):
        slopes = rng.standard_normal(20).astype(np.float32)
        want = (1 - 0.03) * want - 0.4 * (matrix @ slopes)
        assert control(slopes) == pytest.approx(want, abs=1e-4)
        assert control.residual == pytest.approx(matrix @ slopes, abs=1e-5)


def test_it_goes_on_from_what_the_mirror_really_did(matrix):
    control = LeakyIntegrator(matrix, 0.4, 0.1)
    slopes = np.ones(20, np.float32)
    control(slopes)
    done = np.arange(7.0)
    control.applied(done)
    assert control(slopes) == pytest.approx(0.9 * done - 0.4 * (matrix @ slopes), abs=1e-5)
    # What the caller gave stays the caller's.
    assert done.tolist() == list(range(7))


def test_reset_forgets(matrix):
    control = LeakyIntegrator(matrix, 0.4, 0.0)
    control(np.ones(20, np.float32))
    control.reset()
    assert not control.state.any()


@pytest.mark.parametrize(("gain", "leak"), [(0.0, 0.1), (-1.0, 0.1), (0.3, -0.1), (0.3, 1.1)])
def test_impossible_settings_are_refused(matrix, gain, leak):
    with pytest.raises(ValueError, match="must"):
        LeakyIntegrator(matrix, gain, leak)


@pytest.mark.parametrize("delay", [1, 2, 3])
def test_the_gain_limit_is_where_the_loop_turns_unstable(delay):
    def grows(gain):
        past = [1.0] * (delay + 1)
        for _ in range(4000):
            past.append(past[-1] - gain * past[-delay])
        return max(abs(v) for v in past[-50:]) > max(abs(v) for v in past[100:150])

    limit = gain_limit(delay)
    assert grows(1.02 * limit)
    assert not grows(0.98 * limit)
