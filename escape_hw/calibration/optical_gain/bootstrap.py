"""Bootstrap of the optical gains (paper, PyWFS section): close the loop, measure, rescale, repeat with smaller pokes."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.optical_gains import ClosureStep, GainRound, GainsResult, OpticalGains
from escape_hw.api.procedure import Procedure, Progress
from escape_hw.api.results import CalibrationResult, StrehlEstimate
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.pokes import (
    compute_poke_amplitudes,
    noise_gain,
    scale_to_strehl_budget,
    strehl_loss,
)
from escape_hw.calibration.optical_gain.estimator import GainMeasurementLoop, LoopSegment, OpticalGainEstimate
from escape_hw.calibration.optical_gain.loop_closure import bootstrap_loop
from escape_hw.calibration.optical_gain.matrix_comparison import scale_matrix
from escape_hw.calibration.optical_gain.smoothing import smooth_over_modes, usable
from escape_hw.errors import Aborted, CalibrationError, ConfigError
from escape_hw.pipeline.psf.strehl import strehl
from escape_hw.pipeline.statistics import MIN_SAMPLES

#: Poke of the first closure and first round; each round halves it.
_FIRST_POKE, _POKE_FACTOR = 0.004, 0.5
#: Frames per mode at each gain of the first closure, and at least.
_FRAMES_PER_MODE, _MIN_FRAMES = 4, 400
#: Accuracy of the rounds before the last poke, relative to the one asked for.
_EARLY_ACCURACY_FACTOR = 2.0
#: Change between two rounds that counts as none, beside twice what the errors let expect.
_TOLERANCE = 0.02
#: Rounds at most at the last poke.
_MAX_LAST_ROUNDS = 4
#: How often, and by how much, the gain is lowered when a round finds the loop unstable.
_MAX_RETRIES, _GAIN_REDUCTION = 3, 0.7


@dataclass(slots=True, eq=False)
class BootstrapState:
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
class BootstrapTarget:
    """What :func:`~escape_hw.calibration.optical_gain.bootstrap.bootstrap_gains` is asked for."""

    poke: float
    accuracy: float
    budget: float
    frames: int
    model_psf: NDArray[np.float32] | None


def close_and_scale_loop(
    loop: GainMeasurementLoop, target_gain: float, poke: float, state: BootstrapState
) -> Procedure[None]:
    """Close the loop at the effective gain wanted, and scale its matrix by what was measured."""
    matrix = loop.reference
    amplitude = compute_poke_amplitudes(loop.bench, matrix.m2c, max(poke, _FIRST_POKE))
    frames = max(_FRAMES_PER_MODE * matrix.n_modes, _MIN_FRAMES)
    closure = yield from bootstrap_loop(loop, target_gain, amplitude, frames, state.steps)
    state.applied = smooth_gains(closure.gains)
    state.gain = target_gain
    _apply_gains(loop, state)
    yield gain_progress(state)


def rounds(
    loop: GainMeasurementLoop, target: BootstrapTarget, comparison_names: list[str], state: BootstrapState
) -> Procedure[None]:
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
    poke_size, repeats = max(target.poke, _FIRST_POKE), 0
    min_frames = max(_FRAMES_PER_MODE * loop.reference.n_modes, _MIN_FRAMES)
    while repeats < _MAX_LAST_ROUNDS and not state.converged:
        is_last_poke = poke_size <= target.poke
        amplitude = compute_poke_amplitudes(loop.bench, loop.reference.m2c, poke_size)
        if is_last_poke:
            amplitude = scale_to_strehl_budget(
                amplitude,
                target.budget,
                *_stroke_and_wavelength(loop.bench),
                _poke_variance_factor(loop, state),
            )
        state.amplitude = float(amplitude.max())
        accuracy = target.accuracy * (1 if is_last_poke else _EARLY_ACCURACY_FACTOR)
        segment = yield from loop.measure(
            min_frames, amplitude, f"round {len(state.rounds) + 1}, poke {amplitude.max():.2g}",
            max_frames=target.frames, is_sufficient=partial(_is_accurate, target=accuracy),
        )  # fmt: skip
        if segment.diverged or segment.gains is None or _residual_is_high(segment, state):
            _lower_gain(loop, segment, state)
            continue
        state.beside = {name: smooth_gains(segment.gains, k + 1) for k, name in enumerate(comparison_names)}
        _record_round(loop, segment, segment.gains, amplitude, accuracy, target.model_psf, state)
        yield gain_progress(state)
        state.converged = is_last_poke and _is_consistent(state.rounds[-1])
        repeats += is_last_poke
        poke_size = max(target.poke, poke_size * _POKE_FACTOR)


def _lower_gain(loop: GainMeasurementLoop, segment: LoopSegment, state: BootstrapState) -> None:
    """Open a loop that was not stable, and lower its gain; raises when that was done often enough."""
    state.retries += 1
    if state.retries > _MAX_RETRIES:
        reason = "diverged" if segment.diverged else (segment.reason or "swings")
        raise CalibrationError(
            f"the loop does not stay closed: at an effective gain of {state.gain:.2f} it {reason}; "
            "lower loop.gain, drop more modes, or measure the matrix again"
        )
    state.gain *= _GAIN_REDUCTION
    state.notes.append(f"the loop was not stable; its gain was lowered to {state.gain:.3g}")
    loop.open_loop()
    loop.control.set_gain(state.gain)


def gain_progress(state: BootstrapState) -> Progress:
    """The gains so far, round by round."""
    gains, count = state.applied, len(state.rounds)
    if gains is None:
        raise RuntimeError("no gains were measured yet")
    arrays = {"gains": gains.value, "gains_sigma": gains.sigma, "gains_smooth": gains.trend}
    if count:
        arrays["gains_rounds"] = np.stack([one.gains.best for one in state.rounds])
    small = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Progress("optical gains", count, max(count, 1), "round", arrays=small)


def _is_accurate(measured: OpticalGainEstimate, target: float) -> bool:
    """Whether gains are known as well as asked for."""
    return _relative_error(smooth_gains(measured)) <= target


def _residual_is_high(segment: LoopSegment, state: BootstrapState) -> bool:
    """Whether the residual is far above what it was: a pyramid's slopes saturate before the mirror does."""
    known = [step.residual_nm for step in state.steps if step.stable and math.isfinite(step.residual_nm)]
    return bool(known) and segment.residual_nm > 1.5 * max(known)


def _record_round(
    loop: GainMeasurementLoop,
    segment: LoopSegment,
    measured: OpticalGainEstimate,
    amplitude: NDArray[np.float64],
    accuracy: float,
    model_psf: NDArray[np.float32] | None,
    state: BootstrapState,
) -> None:
    """Take down a round, and scale the matrix by what it found."""
    smoothed_gains, previous = smooth_gains(measured), state.applied
    if previous is None:
        raise RuntimeError("the loop was never closed")
    change = smoothed_gains.best / usable(previous) - 1
    expected = np.hypot(smoothed_gains.best_sigma / smoothed_gains.best, previous.best_sigma / previous.best)
    expected = np.hypot(expected, math.hypot(smoothed_gains.common_sigma, previous.common_sigma))
    state.rounds.append(
        GainRound(
            smoothed_gains,
            float(amplitude.max()),
            segment.frames,
            rms(change),
            rms(expected),
            segment.residual_nm,
            strehl_loss(amplitude, *_stroke_and_wavelength(loop.bench), _poke_variance_factor(loop, state)),
            _relative_error(smoothed_gains) <= accuracy,
            _strehl(segment, model_psf),
        )
    )
    state.applied = smoothed_gains
    _apply_gains(loop, state)


def _apply_gains(loop: GainMeasurementLoop, state: BootstrapState) -> None:
    """Scale the matrix by the gains; then the loop's own gain is the one wanted."""
    if state.applied is None:
        raise RuntimeError("no gains were measured yet")
    loop.scale(usable(state.applied))
    loop.control.set_gain(state.gain)


def _strehl(segment: LoopSegment, model_psf: NDArray[np.float32] | None) -> StrehlEstimate | None:
    """Of the science frames of a round, when there were enough of them."""
    if model_psf is None or segment.record.science.count < MIN_SAMPLES:
        return None
    return strehl(segment.record.science.images(), model_psf)


def _is_consistent(one: GainRound) -> bool:
    """Whether a round found, to the accuracy asked for, the gains that it ran with."""
    return one.reached and one.change <= max(_TOLERANCE, 2 * one.expected_change)


def smooth_gains(measured: OpticalGainEstimate, reference: int = 0) -> OpticalGains:
    """Gains relative to one of the loop's matrices, smoothed over the modes."""
    return smooth_over_modes(measured.value[reference], measured.sigma[reference], measured.common_sigma)


def _relative_error(gains: OpticalGains) -> float:
    """Relative standard error, rms over the modes."""
    return math.hypot(rms(gains.best_sigma / gains.best), gains.common_sigma)


def rms(values: NDArray[np.float64]) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _stroke_and_wavelength(bench: Bench) -> tuple[float, float]:
    return bench.dm.info.stroke_m, bench.config.system.wavelength_m


def _poke_variance_factor(loop: GainMeasurementLoop, state: BootstrapState) -> float:
    """Factor of the loop on the pokes' variance, by the delay known from the matrix."""
    delay = float(loop.reference.metrics.get("delay_frames", 2.0))
    return noise_gain(state.gain, loop.bench.config.loop.leak, delay)


#: Name of the matrix that only lends its shape, among those beside.
_CLOSED_LOOP_MATRIX = "shape"


@dataclass(frozen=True, slots=True, eq=False)
class GainsRun:
    """A bootstrap, and the matrix scaled by its gains: the one to close the loop with.

    The matrix is as it was when no round was finished.
    """

    result: GainsResult
    rescaled_calibration: CalibrationResult

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.result!r}\n  rescaled: {self.rescaled_calibration.matrix!r}>"


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
        (:func:`~escape_hw.calibration.sprint.synthetic_matrix.at_rest`): the one that is scaled in the end, by gains
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
    target_gain = bench.config.loop.gain if gain is None else gain
    _require_fractions(poke=poke, accuracy=accuracy, budget=budget, gain=target_gain)
    state, all_comparisons = (
        BootstrapState(),
        {**(beside or {}), **({} if shape is None else {_CLOSED_LOOP_MATRIX: shape})},
    )
    loop = GainMeasurementLoop(bench, calibration, all_comparisons, science=model_psf is not None)
    with loop.closed():
        try:
            yield from close_and_scale_loop(loop, target_gain, poke, state)
            yield from rounds(
                loop, BootstrapTarget(poke, accuracy, budget, frames, model_psf), list(all_comparisons), state
            )
        except Aborted:
            state.partial = True
            _save_partial_round(loop, state)
    return _build_run(loop, calibration, shape, state, loop.lost_frames)


def _save_partial_round(loop: GainMeasurementLoop, state: BootstrapState) -> None:
    """Keep what a round told that was aborted after enough frames; the loop is about to be opened."""
    measured = loop.solve_latest()
    if state.applied is None or measured is None:
        return
    smoothed_gains = smooth_gains(measured)
    change = smoothed_gains.best / usable(state.applied) - 1
    state.rounds.append(
        GainRound(
            smoothed_gains, state.amplitude, measured.frames, rms(change), math.nan, math.nan, math.nan, False
        )
    )
    state.applied = smoothed_gains


def _require_fractions(**numbers: float) -> None:
    for name, value in numbers.items():
        if not 0 < value < 1:
            raise ConfigError(f"{name} is {value}; it must lie between 0 and 1")


def _build_run(
    loop: GainMeasurementLoop,
    calibration: CalibrationResult,
    shape: InteractionMatrix | None,
    state: BootstrapState,
    lost: int,
) -> GainsRun:
    rescaled_calibration, notes = calibration, list(state.notes)
    closed_loop_gains = state.beside.pop(_CLOSED_LOOP_MATRIX, None)
    if state.rounds and state.applied is not None:
        scaled, gains = calibration.matrix, state.applied
        # A run that was stopped early may not have told the other's gains.
        if shape is not None and closed_loop_gains is not None:
            scaled, gains = shape, closed_loop_gains
        sigma = np.hypot(gains.best_sigma, gains.best * gains.common_sigma)
        matrix = scale_matrix(scaled, usable(gains), sigma)
        rescaled_calibration = replace(calibration, matrix=matrix, measured=None, partial=state.partial)
        if not state.rounds[-1].reached:
            notes.append("the last round ended at its number of frames, before the accuracy asked for")
    result = GainsResult(
        calibration.matrix.method, tuple(state.rounds), tuple(state.steps), state.converged, state.gain,
        loop.frames, lost, state.beside, state.partial, tuple(notes),
    )  # fmt: skip
    return GainsRun(result, rescaled_calibration)
