"""The rounds of the optical gains' bootstrap: poke, measure, rescale, poke less."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from functools import partial

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.gains import ClosureStep, GainRound, OpticalGains
from escape_hw.api.procedure import Procedure, Progress
from escape_hw.api.results import StrehlEstimate
from escape_hw.bench import Bench
from escape_hw.calibration.first_closure import close_first
from escape_hw.calibration.gain_loop import GainLoop, Stretch
from escape_hw.calibration.gain_meter import MeasuredGains
from escape_hw.calibration.gain_smoothing import smoothed, usable
from escape_hw.calibration.poke_cost import noise_gain, strehl_loss, within_budget
from escape_hw.calibration.sensor_setup import poke_amplitudes
from escape_hw.errors import CalibrationError
from escape_hw.pipeline.standard_error import LEAST
from escape_hw.pipeline.strehl import strehl

#: Poke of the first closure and first round; each round halves it.
_FIRST_POKE, _LESS = 0.004, 0.5
#: Frames per mode at each gain of the first closure, and at least.
_CLOSING_FRAMES, _LEAST_FRAMES = 4, 400
#: Accuracy of the rounds before the last poke, relative to the one asked for.
_COARSE = 2.0
#: Change between two rounds that counts as none, beside twice what the errors let expect.
_TOLERANCE = 0.02
#: Rounds at most at the last poke.
_REPEATS = 4
#: How often, and by how much, the gain is lowered when a round finds the loop unstable.
_RETRIES, _LOWER = 3, 0.7


@dataclass(slots=True, eq=False)
class Bootstrap:
    """What the bootstrap has so far."""

    applied: OpticalGains | None = None
    steps: list[ClosureStep] = field(default_factory=list)
    rounds: list[GainRound] = field(default_factory=list)
    beside: dict[str, OpticalGains] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    gain: float = math.nan
    amplitude: float = math.nan
    retries: int = 0
    converged: bool = False
    partial: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class Asked:
    """What :func:`~escape_hw.calibration.gain_bootstrap.bootstrap_gains` is asked for."""

    poke: float
    accuracy: float
    budget: float
    frames: int
    model_psf: NDArray[np.float32] | None


def first_closure(loop: GainLoop, wanted: float, poke: float, state: Bootstrap) -> Procedure[None]:
    """Close the loop at the effective gain wanted, and scale its matrix by what was measured."""
    matrix = loop.reference
    amplitude = poke_amplitudes(loop.bench, matrix.m2c, max(poke, _FIRST_POKE))
    frames = max(_CLOSING_FRAMES * matrix.n_modes, _LEAST_FRAMES)
    closure = yield from close_first(loop, wanted, amplitude, frames, state.steps)
    state.applied = smooth(closure.gains)
    state.gain = wanted
    _apply(loop, state)
    yield shown(state)


def rounds(loop: GainLoop, asked: Asked, others: list[str], state: Bootstrap) -> Procedure[None]:
    """Measure and rescale with ever smaller pokes, until two rounds at the last poke agree.

    Parameters
    ----------
    loop
        Closed, its matrix scaled by the gains of the first closure.
    asked
        What to go on for.
    others
        Names of the loop's matrices beside the one that closes it.
    state
        Takes down what is found, as it goes.

    Raises
    ------
    CalibrationError
        The loop does not stay closed; says why.
    """
    size, repeats = max(asked.poke, _FIRST_POKE), 0
    least = max(_CLOSING_FRAMES * loop.reference.n_modes, _LEAST_FRAMES)
    while repeats < _REPEATS and not state.converged:
        last = size <= asked.poke
        amplitude = poke_amplitudes(loop.bench, loop.reference.m2c, size)
        if last:
            amplitude = within_budget(amplitude, asked.budget, *_optics(loop.bench), _raised(loop, state))
        state.amplitude = float(amplitude.max())
        accuracy = asked.accuracy * (1 if last else _COARSE)
        stretch = yield from loop.measure(
            least, amplitude, f"round {len(state.rounds) + 1}, poke {amplitude.max():.2g}",
            most=asked.frames, enough=partial(_accurate, asked=accuracy),
        )  # fmt: skip
        if stretch.diverged or stretch.gains is None or _swings(stretch, state):
            _calm(loop, stretch, state)
            continue
        state.beside = {name: smooth(stretch.gains, k + 1) for k, name in enumerate(others)}
        _book(loop, stretch, stretch.gains, amplitude, accuracy, asked.model_psf, state)
        yield shown(state)
        state.converged = last and _agrees(state.rounds[-1])
        repeats += last
        size = max(asked.poke, size * _LESS)


def _calm(loop: GainLoop, stretch: Stretch, state: Bootstrap) -> None:
    """Open a loop that was not stable, and lower its gain; raises when that was done often enough."""
    state.retries += 1
    if state.retries > _RETRIES:
        why = "diverged" if stretch.diverged else (stretch.why or "swings")
        raise CalibrationError(
            f"the loop does not stay closed: at an effective gain of {state.gain:.2f} it {why}; "
            "lower loop.gain, drop more modes, or measure the matrix again"
        )
    state.gain *= _LOWER
    state.notes.append(f"the loop was not stable; its gain was lowered to {state.gain:.3g}")
    loop.open_again()
    loop.control.set_gain(state.gain)


def shown(state: Bootstrap) -> Progress:
    """The gains so far, round by round."""
    gains, count = state.applied, len(state.rounds)
    if gains is None:
        raise RuntimeError("no gains were measured yet")
    arrays = {"gains": gains.value, "gains_sigma": gains.sigma, "gains_smooth": gains.trend}
    if count:
        arrays["gains_rounds"] = np.stack([one.gains.best for one in state.rounds])
    small = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Progress("optical gains", count, max(count, 1), "round", arrays=small)


def _accurate(measured: MeasuredGains, asked: float) -> bool:
    """Whether gains are known as well as asked for."""
    return _error(smooth(measured)) <= asked


def _swings(stretch: Stretch, state: Bootstrap) -> bool:
    """Whether the residual is far above what it was: a pyramid's slopes saturate before the mirror does."""
    known = [step.residual_nm for step in state.steps if step.stable and math.isfinite(step.residual_nm)]
    return bool(known) and stretch.residual_nm > 1.5 * max(known)


def _book(
    loop: GainLoop,
    stretch: Stretch,
    measured: MeasuredGains,
    amplitude: NDArray[np.float64],
    accuracy: float,
    model_psf: NDArray[np.float32] | None,
    state: Bootstrap,
) -> None:
    """Take down a round, and scale the matrix by what it found."""
    found, old = smooth(measured), state.applied
    if old is None:
        raise RuntimeError("the loop was never closed")
    change = found.best / usable(old) - 1
    expected = np.hypot(found.best_sigma / found.best, old.best_sigma / old.best)
    expected = np.hypot(expected, math.hypot(found.common_sigma, old.common_sigma))
    state.rounds.append(
        GainRound(
            found,
            float(amplitude.max()),
            stretch.frames,
            rms(change),
            rms(expected),
            stretch.residual_nm,
            strehl_loss(amplitude, *_optics(loop.bench), _raised(loop, state)),
            _error(found) <= accuracy,
            _strehl(stretch, model_psf),
        )
    )
    state.applied = found
    _apply(loop, state)


def _apply(loop: GainLoop, state: Bootstrap) -> None:
    """Scale the matrix by the gains; then the loop's own gain is the one wanted."""
    if state.applied is None:
        raise RuntimeError("no gains were measured yet")
    loop.scale(usable(state.applied))
    loop.control.set_gain(state.gain)


def _strehl(stretch: Stretch, model_psf: NDArray[np.float32] | None) -> StrehlEstimate | None:
    """Of the science frames of a round, when there were enough of them."""
    if model_psf is None or stretch.record.science.count < LEAST:
        return None
    return strehl(stretch.record.science.images(), model_psf)


def _agrees(one: GainRound) -> bool:
    """Whether a round found, to the accuracy asked for, the gains that it ran with."""
    return one.reached and one.change <= max(_TOLERANCE, 2 * one.expected_change)


def smooth(measured: MeasuredGains, reference: int = 0) -> OpticalGains:
    """Gains relative to one of the loop's matrices, smoothed over the modes."""
    return smoothed(measured.value[reference], measured.sigma[reference], measured.common_sigma)


def _error(gains: OpticalGains) -> float:
    """Relative standard error, rms over the modes."""
    return math.hypot(rms(gains.best_sigma / gains.best), gains.common_sigma)


def rms(values: NDArray[np.float64]) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _optics(bench: Bench) -> tuple[float, float]:
    return bench.dm.info.stroke_m, bench.config.system.wavelength_m


def _raised(loop: GainLoop, state: Bootstrap) -> float:
    """Factor of the loop on the pokes' variance, by the delay known from the matrix."""
    delay = float(loop.reference.metrics.get("delay_frames", 2.0))
    return noise_gain(state.gain, loop.bench.config.loop.leak, delay)
