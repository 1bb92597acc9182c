"""DO-CRIME in closed loop over seeds: unbiased for any controller, with correct errors."""

from __future__ import annotations

import numpy as np
import pytest
import simulated_loop as simulated

from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.errors import CalibrationError

SEEDS, FRAMES = 10, 2500
#: A line that the filter does not know, far stronger than the noise.
VIBRATION = 0.03 * np.sin(0.9 * np.arange(FRAMES))[:, None] * np.cos(np.arange(simulated.N_SLOPES))
CONTROLLERS = {
    "integrator": {},
    "leaky integrator": {"leak": 0.05},
    "gains of modes": {"gain": np.linspace(0.05, 0.6, simulated.N_MODES)},
    "commands cut by the limits": {"limit": 0.08},
    "a law that rounds": {"law": lambda modes: np.round(modes, 2)},
    "a matrix wrong by half": {"matrix_scale": 2.0},
    "lost frames": {"lost": 0.05},
    "vibration": {"extra": VIBRATION},
}


def gain_of(matrix, truth):
    return float(np.vdot(matrix, truth) / np.vdot(truth, truth))


@pytest.mark.parametrize("name", CONTROLLERS)
@pytest.mark.slow
def test_unbiased_for_any_controller_and_least_squares_is_not(name):
    gains, pulls, squares, modes, delays, plain = [], [], [], [], [], []
    for seed in range(SEEDS):
        run = simulated.loop(seed, frames=FRAMES, **CONTROLLERS[name])
        found = run.fit()
        gain = gain_of(found.matrix, run.truth)
        # The common gain errs by that of the response, and by the mean of what single elements err by.
        own = np.sqrt(np.square(found.sigma * run.truth).sum()) / np.square(run.truth).sum()
        gains.append(gain)
        pulls.append((gain - 1) / np.hypot(found.gain_sigma, own))
        squares.append(np.mean(np.square((found.matrix - gain * run.truth) / found.sigma)))
        modes.append([gain_of(a, b) for a, b in zip(found.matrix.T, run.truth.T, strict=True)])
        delays.append(found.response.delay_frames)
        plain.append(gain_of(run.fit(closed=False).matrix, run.truth))
    error = np.std(gains) / np.sqrt(SEEDS)
    assert abs(np.mean(gains) - 1) < 4 * error
    assert error < 0.02
    assert np.mean(np.square(pulls)) < 2.5
    assert np.mean(squares) == pytest.approx(1, abs=0.1)
    # No mode has a bias of its own.
    worst = (np.mean(modes, axis=0) - 1) / (np.std(modes, axis=0, ddof=1) / np.sqrt(SEEDS))
    assert np.abs(worst).max() < 6
    assert np.mean(delays) == pytest.approx(2.55, abs=0.03)
    # Least squares on the whole command takes the loop's answer to the turbulence for the mirror's response.
    assert abs(np.mean(plain) - 1) > 0.2


def test_in_open_loop_instruments_are_least_squares():
    run = simulated.loop(3, gain=1e-9, frames=FRAMES)
    with_instruments, without = run.fit(), run.fit(closed=False)
    assert with_instruments.matrix == pytest.approx(without.matrix, rel=5e-3, abs=1e-2)
    assert with_instruments.sigma == pytest.approx(without.sigma, rel=0.02)
    assert with_instruments.response.weights == pytest.approx(without.response.weights, abs=5e-3)


def test_the_noise_is_distinguished_from_the_motion_of_the_loop():
    """The stated error depends on the turbulence, not on how much the loop moves the mirror."""
    quiet, busy = (simulated.loop(5, frames=FRAMES, gain=gain).fit() for gain in (0.05, 0.6))
    assert np.median(busy.variance) == pytest.approx(np.median(quiet.variance), rel=0.15)


def test_the_error_falls_with_the_frames_and_the_poke():
    short, long, strong = (
        simulated.loop(7, frames=frames, poke=poke).fit().sigma.mean()
        for frames, poke in ((2000, 0.01), (8000, 0.01), (2000, 0.02))
    )
    assert short / long == pytest.approx(2, rel=0.1)
    assert short / strong == pytest.approx(2, rel=0.1)


@pytest.mark.parametrize("closed", [True, False])
@pytest.mark.parametrize("lags", [2, 3])
def test_a_delay_beyond_the_lags_is_reported(closed, lags):
    """Too few lags would give a matrix that is too small, or has the wrong sign, with small errors."""
    run = simulated.loop(1, frames=FRAMES, poke=0.02, gain=0.2 if closed else 1e-9)
    excitation = np.concatenate([run.commands, run.pokes], axis=1) if closed else run.commands
    blind = DocrimeEstimator(
        simulated.N_SLOPES,
        simulated.N_MODES,
        order=simulated.ORDER,
        lags=lags,
        closed=closed,
        correlations=False,
    )
    with pytest.raises(
        CalibrationError, match=r"responds to pokes [23] frames after .* calibration.lags to at least [56]"
    ):
        blind.extend(run.index, run.slopes, excitation).solve()


def test_without_a_response_there_is_no_matrix():
    run = simulated.loop(2, frames=FRAMES)
    rng = np.random.default_rng(0)
    pokes = rng.uniform(-0.01, 0.01, run.pokes.shape)
    estimator = DocrimeEstimator(simulated.N_SLOPES, simulated.N_MODES, order=simulated.ORDER, closed=True)
    # Pokes that were never sent: commands and slopes know nothing of them.
    with pytest.raises(CalibrationError):
        estimator.extend(run.index, run.slopes, np.concatenate([run.commands, pokes], axis=1)).solve()


def test_what_the_mirror_did_before_a_resumed_run_is_not_made_up():
    """A closed loop is resumed in mid-motion: its first rows must not pass for those of a flat mirror."""
    sizes, squares = [], []
    for seed in range(4):
        run = simulated.loop(seed, frames=4000)
        whole = run.fit()
        excitation = np.concatenate([run.commands, run.pokes], axis=1)
        state = None
        for part in np.array_split(np.arange(4000), 2):
            estimator = DocrimeEstimator(
                simulated.N_SLOPES, simulated.N_MODES, order=simulated.ORDER, lags=simulated.LAGS, closed=True
            )
            if state is not None:
                estimator.restore(*state)
            # The second process counts its own frames.
            estimator.extend(np.arange(part.size), run.slopes[part], excitation[part])
            state = estimator.state()
        resumed = estimator.solve()
        assert resumed.frames == 4000 - simulated.LAGS
        assert resumed.lost_frames == 0
        sizes.append(np.median(resumed.sigma / whole.sigma))
        squares.append(np.mean(np.square((resumed.matrix - whole.matrix) / whole.sigma)))
    assert np.mean(sizes) == pytest.approx(1, abs=0.03)
    # A dozen rows of four thousand are missing; nothing else changed.
    assert np.mean(squares) < 0.05


def test_a_command_without_its_poke_is_refused():
    estimator = DocrimeEstimator(4, 2, closed=True)
    with pytest.raises(ValueError, match="beside the command"):
        estimator.partial_fit(0, np.zeros(4, np.float32), np.zeros(2))
    with pytest.raises(ValueError, match="order is 0"):
        DocrimeEstimator(4, 2, order=0, closed=True)
