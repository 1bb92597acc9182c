"""The bootstrap of the optical gains: close, measure, rescale, poke less, again (paper, PyWFS section)."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.gains import ClosureStep, GainRound, GainsResult, OpticalGains
from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.procedure import Procedure, Progress
from escape_hw.api.results import CalibrationResult, StrehlEstimate
from escape_hw.bench import Bench
from escape_hw.calibration.first_closure import close_first
from escape_hw.calibration.gain_loop import GainLoop, Stretch
from escape_hw.calibration.gain_meter import MeasuredGains
from escape_hw.calibration.gain_smoothing import smoothed
from escape_hw.calibration.optical_gain import scaled_matrix
from escape_hw.calibration.poke_cost import noise_gain, strehl_loss, within_budget
from escape_hw.calibration.sensor_setup import poke_amplitudes
from escape_hw.errors import Aborted, CalibrationError, ConfigError
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
#: Name of the matrix that only lends its shape, among those beside.
_SHAPE = "shape"
#: How often, and by how much, the gain is lowered when a round finds the loop unstable.
_RETRIES, _LOWER = 3, 0.7


@dataclass(frozen=True, slots=True, eq=False)
class GainsRun:
    """A bootstrap, and the matrix scaled by its gains: the one to close the loop with.

    The matrix is as it was when no round was finished.
    """

    result: GainsResult
    rescaled: CalibrationResult

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.result!r}\n  rescaled: {self.rescaled.matrix!r}>"


@dataclass(slots=True, eq=False)
class _State:
    """What the bootstrap has so far."""

    applied: OpticalGains | None = None
    steps: list[ClosureStep] = field(default_factory=list)
    rounds: list[GainRound] = field(default_factory=list)
    beside: dict[str, OpticalGains] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    gain: float = math.nan
    amplitude: float = math.nan
    converged: bool = False
    partial: bool = False


def bootstrap_gains(
    bench: Bench,
    calibration: CalibrationResult,
    *,
    poke: float = 0.002,
    accuracy: float = 0.01,
    budget: float = 0.01,
    frames: int = 20000,
    gain: float | None = None,
    beside: Mapping[str, InteractionMatrix] | None = None,
    shape: InteractionMatrix | None = None,
    model_psf: NDArray[np.float32] | None = None,
) -> Procedure[GainsRun]:
    """Close the loop on a matrix of unknown scale, and scale it mode by mode to the turbulence there.

    Parameters
    ----------
    bench
        An open bench, under the turbulence that the gains are wanted for.
    calibration
        A matrix of high signal-to-noise ratio, best a pseudo-synthetic one, and its geometry.
    poke
        Last and smallest poke of each mode, rms surface as fraction of full stroke (paper: 0.001 to 0.002).
    accuracy
        Relative standard error of the gains to go on for, rms over the modes.
    budget
        Share of the Strehl ratio that the last pokes may cost; they are lowered to it.
    frames
        Frames per round at most.
    gain
        Effective gain of the loop; as configured by default.
    beside
        Other matrices by name, of the same geometry and modes, whose gains are wanted, too.
    shape
        A matrix of the same geometry and modes, of any scale, whose columns are better in closed loop
        (:func:`~escape_hw.calibration.pseudo_synthetic.at_rest`): the one that is scaled in the end, by gains
        of its own that the same frames tell. The result's gains are those of ``calibration``.
    model_psf
        With it, and with a science camera, every round tells its Strehl ratio.

    Returns
    -------
    GainsRun
        ``result.converged`` says whether to trust it. Stopped early, ``result.partial`` is true.

    Raises
    ------
    ConfigError
        A number that means nothing; nothing moved.
    IncompatibleProduct
        A matrix belongs to another mirror, grid or camera region; nothing moved.
    CalibrationError
        The loop does not close, or does not stay closed; says why.
    """
    wanted = bench.config.loop.gain if gain is None else gain
    _require_sense(poke=poke, accuracy=accuracy, budget=budget, gain=wanted)
    state, others = _State(), {**(beside or {}), **({} if shape is None else {_SHAPE: shape})}
    loop = GainLoop(bench, calibration, others, science=model_psf is not None)
    before = bench.wfs.status().lost
    try:
        loop.start()
        before = bench.wfs.status().lost
        yield from _closed(loop, wanted, poke, state)
        yield from _rounds(loop, wanted, poke, accuracy, budget, frames, list(others), model_psf, state)
    except Aborted:
        state.partial = True
        _salvage(loop, state)
    finally:
        loop.open_again()
    return _run_of(loop, calibration, shape, state, bench.wfs.status().lost - before)


def _salvage(loop: GainLoop, state: _State) -> None:
    """Keep what a round told that was aborted after enough frames; the loop is about to be opened."""
    measured = loop.so_far()
    if state.applied is None or measured is None:
        return
    found = _smooth(measured, 0)
    change = found.best / usable(state.applied) - 1
    state.rounds.append(
        GainRound(found, state.amplitude, measured.frames, _rms(change), math.nan, math.nan, math.nan, False)
    )
    state.applied = found


def _require_sense(**numbers: float) -> None:
    for name, value in numbers.items():
        if not 0 < value < 1:
            raise ConfigError(f"{name} is {value}; it must lie between 0 and 1")


def _closed(loop: GainLoop, wanted: float, poke: float, state: _State) -> Procedure[None]:
    """Close the loop and scale its matrix by what was measured."""
    matrix = loop.reference
    amplitude = poke_amplitudes(loop.bench, matrix.m2c, max(poke, _FIRST_POKE))
    frames = max(_CLOSING_FRAMES * matrix.n_modes, _LEAST_FRAMES)
    closure = yield from close_first(loop, wanted, amplitude, frames, state.steps)
    state.applied = _smooth(closure.gains, 0)
    state.gain = wanted
    _apply(loop, state)
    yield _shown(state)


def _apply(loop: GainLoop, state: _State) -> None:
    """Scale the matrix by the gains; then the loop's own gain is the one wanted."""
    if state.applied is None:
        raise RuntimeError("no gains were measured yet")
    loop.scale(usable(state.applied))
    loop.control.set_gain(state.gain)


def _rounds(
    loop: GainLoop,
    wanted: float,
    poke: float,
    accuracy: float,
    budget: float,
    frames: int,
    others: list[str],
    model_psf: NDArray[np.float32] | None,
    state: _State,
) -> Procedure[None]:
    size, repeats, retries = max(poke, _FIRST_POKE), 0, 0
    least = max(_CLOSING_FRAMES * loop.reference.n_modes, _LEAST_FRAMES)
    while repeats < _REPEATS and not state.converged:
        last = size <= poke
        amplitude = poke_amplitudes(loop.bench, loop.reference.m2c, size)
        if last:
            amplitude = within_budget(amplitude, budget, *_optics(loop.bench), _raised(loop, state))
        state.amplitude = float(amplitude.max())
        asked = accuracy if last else _COARSE * accuracy
        stretch = yield from loop.measure(
            least, amplitude, f"round {len(state.rounds) + 1}, poke {amplitude.max():.2g}",
            most=frames, enough=partial(_accurate, asked=asked),
        )  # fmt: skip
        if stretch.diverged or stretch.gains is None or _swings(stretch, state):
            retries += 1
            if retries > _RETRIES:
                why = "diverged" if stretch.diverged else (stretch.why or "swings")
                raise CalibrationError(
                    f"the loop does not stay closed: at an effective gain of {state.gain:.2f} it {why}; "
                    "lower loop.gain, drop more modes, or measure the matrix again"
                )
            state.gain *= _LOWER
            state.notes.append(f"the loop was not stable; its gain was lowered to {state.gain:.3g}")
            loop.open_again()
            loop.control.set_gain(state.gain)
            continue
        state.beside = {name: _smooth(stretch.gains, k + 1) for k, name in enumerate(others)}
        _book(loop, stretch, stretch.gains, amplitude, asked, model_psf, state)
        yield _shown(state)
        state.converged = last and _agrees(state.rounds[-1])
        repeats += last
        size = max(poke, size * _LESS)


def _shown(state: _State) -> Progress:
    """The gains so far, round by round."""
    gains, rounds = state.applied, state.rounds
    if gains is None:
        raise RuntimeError("no gains were measured yet")
    arrays = {"gains": gains.value, "gains_sigma": gains.sigma, "gains_smooth": gains.trend}
    if rounds:
        arrays["gains_rounds"] = np.stack([one.gains.best for one in rounds])
    count = len(rounds)
    shown = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Progress("optical gains", count, max(count, 1), "round", arrays=shown)


def _accurate(measured: MeasuredGains, asked: float) -> bool:
    """Whether gains are known as well as asked for."""
    return _error(_smooth(measured, 0)) <= asked


def _swings(stretch: Stretch, state: _State) -> bool:
    """Whether the residual is far above what it was: a pyramid's slopes saturate before the mirror does."""
    known = [step.residual_nm for step in state.steps if step.stable and math.isfinite(step.residual_nm)]
    return bool(known) and stretch.residual_nm > 1.5 * max(known)


def _book(
    loop: GainLoop,
    stretch: Stretch,
    measured: MeasuredGains,
    amplitude: NDArray[np.float64],
    asked: float,
    model_psf: NDArray[np.float32] | None,
    state: _State,
) -> None:
    """Take down a round, and scale the matrix by what it found."""
    found, old = _smooth(measured, 0), state.applied
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
            _rms(change),
            _rms(expected),
            stretch.residual_nm,
            strehl_loss(amplitude, *_optics(loop.bench), _raised(loop, state)),
            _error(found) <= asked,
            _strehl(stretch, model_psf),
        )
    )
    state.applied = found
    _apply(loop, state)


def _strehl(stretch: Stretch, model_psf: NDArray[np.float32] | None) -> StrehlEstimate | None:
    """Of the science frames of a round, when there were enough of them."""
    if model_psf is None or stretch.record.science.count < LEAST:
        return None
    return strehl(stretch.record.science.images(), model_psf)


def _agrees(one: GainRound) -> bool:
    """Whether a round found, to the accuracy asked for, the gains that it ran with."""
    return one.reached and one.change <= max(_TOLERANCE, 2 * one.expected_change)


def _smooth(measured: MeasuredGains, reference: int) -> OpticalGains:
    return smoothed(measured.value[reference], measured.sigma[reference], measured.common_sigma)


def _error(gains: OpticalGains) -> float:
    """Relative standard error, rms over the modes."""
    return math.hypot(_rms(gains.best_sigma / gains.best), gains.common_sigma)


def usable(gains: OpticalGains) -> NDArray[np.float64]:
    """Gains to scale by: one mode's noise must not turn its sign, nor raise its gain many times."""
    least = 0.3 * float(np.median(gains.trend))
    if not least > 0:
        raise CalibrationError(
            "the optical gains are not positive: the loop works against the turbulence; "
            "measure the matrix again"
        )
    return np.maximum(gains.best, least)


def _rms(values: NDArray[np.float64]) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


def _optics(bench: Bench) -> tuple[float, float]:
    return bench.dm.info.stroke_m, bench.config.system.wavelength_m


def _raised(loop: GainLoop, state: _State) -> float:
    """Factor of the loop on the pokes' variance, by the delay known from the matrix."""
    delay = float(loop.reference.metrics.get("delay_frames", 2.0))
    return noise_gain(state.gain, loop.bench.config.loop.leak, delay)


def _run_of(
    loop: GainLoop,
    calibration: CalibrationResult,
    shape: InteractionMatrix | None,
    state: _State,
    lost: int,
) -> GainsRun:
    rescaled, notes = calibration, list(state.notes)
    lent = state.beside.pop(_SHAPE, None)
    if state.rounds and state.applied is not None:
        scaled, gains = calibration.matrix, state.applied
        # A run that was stopped early may not have told the other's gains.
        if shape is not None and lent is not None:
            scaled, gains = shape, lent
        sigma = np.hypot(gains.best_sigma, gains.best * gains.common_sigma)
        matrix = scaled_matrix(scaled, usable(gains), sigma)
        rescaled = replace(calibration, matrix=matrix, measured=None, partial=state.partial)
        if not state.rounds[-1].reached:
            notes.append("the last round ended at its number of frames, before the accuracy asked for")
    result = GainsResult(
        calibration.matrix.method, tuple(state.rounds), tuple(state.steps), state.converged, state.gain,
        loop.frames, lost, state.beside, state.partial, tuple(notes),
    )  # fmt: skip
    return GainsRun(result, rescaled)
