"""A closed loop of a few slopes with an injected matrix, fast enough for statistics over seeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from scipy.signal import lfilter

from escape_hw.calibration.docrime.estimator import DocrimeEstimator
from escape_hw.pipeline.control.integrator import LeakyIntegrator

N_SLOPES, N_MODES, LAGS, ORDER = 40, 10, 5, 4
RESPONSE = np.array([0.0, 0.0, 0.45, 0.55, 0.0])


@dataclass(frozen=True)
class Recorded:
    """Observed data of a loop, and the true values."""

    index: np.ndarray
    slopes: np.ndarray
    commands: np.ndarray
    pokes: np.ndarray
    truth: np.ndarray

    def fit(self, closed=True, order=ORDER, columns=None):
        """The estimator's solution; ``columns`` other than ``None`` stand for the commands."""
        excitation = self.commands if columns is None else columns
        if closed:
            excitation = np.concatenate([excitation, self.pokes], axis=1)
        estimator = DocrimeEstimator(N_SLOPES, N_MODES, order=order, lags=LAGS, closed=closed)
        return estimator.extend(self.index, self.slopes, excitation).solve()


def turbulence(rng, frames, rms=0.3, pole=0.98):
    """Turbulence of every slope ``(frames, N_SLOPES)``: most of it is in the span of the mirror."""
    kicks = rng.standard_normal((frames + 300, N_SLOPES)) * np.sqrt(1 - pole**2)
    return rms * lfilter([1.0], [1.0, -pole], kicks, axis=0)[300:]


def loop(
    seed,
    gain=0.4,
    leak=0.0,
    frames=3000,
    poke=0.01,
    noise=2e-3,
    limit=np.inf,
    lost=0.0,
    matrix_scale=1.0,
    law=None,
    extra=None,
):
    """Run the loop; pokes are added to the integrator, ``limit`` scales whole commands down.

    ``matrix_scale`` scales the matrix that the loop is closed with, ``law`` is a function on the
    controller's command, ``extra`` is added to the turbulence ``(frames, N_SLOPES)``.
    """
    rng = np.random.default_rng(seed)
    truth = rng.standard_normal((N_SLOPES, N_MODES))
    modal = turbulence(rng, frames) @ np.linalg.pinv(truth).T @ truth.T
    outside = modal + turbulence(rng, frames, 0.05) + rng.normal(0, noise, (frames, N_SLOPES))
    outside += 0 if extra is None else extra
    control = LeakyIntegrator(np.linalg.pinv(truth * matrix_scale).astype(np.float32), gain, leak)
    pokes = rng.uniform(-poke, poke, (frames, N_MODES))
    there = rng.random(frames) >= lost
    there[0] = True
    slopes, sent = np.zeros((frames, N_SLOPES), np.float32), np.zeros((frames, N_MODES))
    padded = np.zeros((frames + LAGS, N_MODES))
    for t in range(frames):
        seen = RESPONSE @ padded[t + LAGS - np.arange(LAGS)]
        slopes[t] = outside[t] + truth @ seen
        if there[t]:
            modes = control(slopes[t])
            total = (modes if law is None else law(modes)) + pokes[t]
            largest = np.abs(total).max()
            sent[t] = total * min(1.0, limit / largest)
            if largest > limit or law is not None:
                control.set_applied(sent[t] - pokes[t])
        else:
            sent[t] = sent[t - 1]
        padded[t + LAGS] = sent[t]
    at = np.flatnonzero(there)
    return Recorded(at, slopes[at], sent[at], pokes[at], truth)
