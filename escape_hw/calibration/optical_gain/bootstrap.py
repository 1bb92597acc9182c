"""Bootstrap of the optical gains (paper, PyWFS section).

Close the loop, measure the gains, rescale the matrix, and repeat with smaller pokes.
"""

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
from escape_hw.calibration.optical_gain.smoothing import clip_gains, smooth_over_modes
from escape_hw.deprecation import renamed_keywords
from escape_hw.errors import Aborted, CalibrationError, ConfigError
from escape_hw.pipeline.psf.strehl import strehl
from escape_hw.pipeline.statistics import MIN_SAMPLES

#: Poke of the first closure and the first round, and its factor from round to round.
_FIRST_POKE, _POKE_FACTOR = 0.004, 0.5
#: Frames per mode at each gain of the first closure, and their minimum.
_FRAMES_PER_MODE, _MIN_FRAMES = 4, 400
#: Accuracy of the rounds before the last poke, relative to the final one.
_EARLY_ACCURACY_FACTOR = 2.0
#: Change between two rounds that is negligible, as is twice the change expected from the errors.
_TOLERANCE = 0.02
#: Largest number of rounds at the last poke.
_MAX_LAST_ROUNDS = 4
#: Largest number of reductions of the gain after an unstable round, and their factor.
_MAX_RETRIES, _GAIN_REDUCTION = 3, 0.7
#: Name of the closed-loop matrix among the comparisons.
_CLOSED_LOOP_MATRIX = "shape"


@dataclass(frozen=True, slots=True, eq=False)
class GainsRun:
    """Result of a bootstrap, and the calibration with the matrix scaled by its gains.

    The matrix is unscaled if no round was finished.
    """

    result: GainsResult
    rescaled_calibration: CalibrationResult

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.result!r}\n  rescaled: {self.rescaled_calibration.matrix!r}>"


@renamed_keywords(beside="comparisons", shape="closed_loop_matrix")
def bootstrap_gains(
    bench: Bench,
    calibration: CalibrationResult,
    *,
    poke: float = 0.002,
    accuracy: float = 0.01,
    budget: float = 0.01,
    frames: int = 20000,
    gain: float | None = None,
    comparisons: Mapping[str, InteractionMatrix] | None = None,
    closed_loop_matrix: InteractionMatrix | None = None,
    model_psf: NDArray[np.float32] | None = None,
) -> Procedure[GainsRun]:
    """Close the loop with a matrix of unknown scale, and scale it mode by mode to the present turbulence.

    Parameters
    ----------
    bench
        An open bench, under the turbulence for which the gains are wanted.
    calibration
        A matrix of high signal-to-noise ratio, preferably pseudo-synthetic, with its geometry.
    poke
        Poke of each mode in the last rounds, rms surface as fraction of full stroke (paper: 0.001 to
        0.002).
    accuracy
        Relative standard error of the gains at which a round ends, rms over the modes.
    budget
        Largest relative loss of Strehl ratio due to the last pokes, which are reduced to it.
    frames
        Largest number of frames per round.
    gain
        Effective gain of the loop; as configured by default.
    comparisons
        Other matrices by name, of the same geometry and modes, whose gains are measured as well.
    closed_loop_matrix
        A matrix of the same geometry and modes, of any scale, whose columns are more accurate in closed loop
        (:func:`~escape_hw.calibration.sprint.synthetic_matrix.static_light_matrix`). It is scaled in the
        end, by its own gains from the same frames. The gains of the result are those of ``calibration``.
    model_psf
        With it, and with a science camera, the Strehl ratio of every round is measured.

    Returns
    -------
    GainsRun
        Do not use the matrix unless ``result.converged``. ``result.partial`` is true if stopped early.

    Raises
    ------
    ConfigError
        A number is not between 0 and 1; nothing moved.
    IncompatibleProduct
        A matrix belongs to another mirror, grid or camera region; nothing moved.
    CalibrationError
        The loop does not close, or does not stay closed.
    """
    target_gain = bench.config.loop.gain if gain is None else gain
    _require_fractions(poke=poke, accuracy=accuracy, budget=budget, gain=target_gain)
    state, all_comparisons = _BootstrapState(), dict(comparisons or {})
    if closed_loop_matrix is not None:
        all_comparisons[_CLOSED_LOOP_MATRIX] = closed_loop_matrix
    loop = GainMeasurementLoop(bench, calibration, all_comparisons, science=model_psf is not None)
    with loop.closed():
        try:
            yield from _close_and_scale_loop(loop, target_gain, poke, state)
            target = _BootstrapTarget(poke, accuracy, budget, frames, model_psf)
            yield from _run_rounds(loop, target, list(all_comparisons), state)
        except Aborted:
            state.partial = True
            _save_partial_round(loop, state)
    return _build_run(loop, calibration, closed_loop_matrix, state, loop.lost_frames)


@dataclass(slots=True, eq=False)
class _BootstrapState:
    """Intermediate results of a bootstrap."""

    applied: OpticalGains | None = None
    steps: list[ClosureStep] = field(default_factory=list)
    rounds: list[GainRound] = field(default_factory=list)
    comparisons: dict[str, OpticalGains] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    gain: float = math.nan
    amplitude: float = math.nan
    retries: int = 0
    converged: bool = False
    partial: bool = False


@dataclass(frozen=True, slots=True, eq=False)
class _BootstrapTarget:
    """Options of :func:`bootstrap_gains`."""

    poke: float
    accuracy: float
    budget: float
    frames: int
    model_psf: NDArray[np.float32] | None


def _close_and_scale_loop(
    loop: GainMeasurementLoop, target_gain: float, poke: float, state: _BootstrapState
) -> Procedure[None]:
    """Close the loop at an effective gain, and scale its matrix by the measured gains."""
    matrix = loop.reference
    amplitude = compute_poke_amplitudes(loop.bench, matrix.m2c, max(poke, _FIRST_POKE))
    frames = max(_FRAMES_PER_MODE * matrix.n_modes, _MIN_FRAMES)
    closure = yield from bootstrap_loop(loop, target_gain, amplitude, frames, state.steps)
    state.gain = target_gain
    _apply_gains(loop, state, _smooth(closure.gains))
    yield _progress(state)


def _run_rounds(
    loop: GainMeasurementLoop, target: _BootstrapTarget, comparison_names: list[str], state: _BootstrapState
) -> Procedure[None]:
    """Measure and rescale with decreasing pokes until two rounds at the last poke agree.

    Raises :class:`CalibrationError` if the loop does not stay closed.
    """
    poke_size, repeats = max(target.poke, _FIRST_POKE), 0
    min_frames = max(_FRAMES_PER_MODE * loop.reference.n_modes, _MIN_FRAMES)
    while repeats < _MAX_LAST_ROUNDS and not state.converged:
        is_last_poke = poke_size <= target.poke
        amplitude = compute_poke_amplitudes(loop.bench, loop.reference.m2c, poke_size)
        if is_last_poke:
            amplitude = scale_to_strehl_budget(amplitude, target.budget, *_strehl_cost(loop, state))
        state.amplitude = float(amplitude.max())
        accuracy = target.accuracy * (1 if is_last_poke else _EARLY_ACCURACY_FACTOR)
        segment = yield from loop.measure(
            min_frames, amplitude, f"round {len(state.rounds) + 1}, poke {amplitude.max():.2g}",
            max_frames=target.frames, is_sufficient=partial(_is_accurate, target=accuracy),
        )  # fmt: skip
        if segment.diverged or segment.gains is None or _residual_is_high(segment, state):
            _lower_gain(loop, segment, state)
            continue
        state.comparisons = {name: _smooth(segment.gains, k + 1) for k, name in enumerate(comparison_names)}
        _record_round(loop, segment, segment.gains, amplitude, accuracy, target.model_psf, state)
        yield _progress(state)
        last = state.rounds[-1]
        is_confirmed = last.reached and last.change <= max(_TOLERANCE, 2 * last.expected_change)
        state.converged = is_last_poke and is_confirmed
        repeats += is_last_poke
        poke_size = max(target.poke, poke_size * _POKE_FACTOR)


def _lower_gain(loop: GainMeasurementLoop, segment: LoopSegment, state: _BootstrapState) -> None:
    """Open an unstable loop and reduce its gain; raises after :data:`_MAX_RETRIES` reductions."""
    state.retries += 1
    if state.retries > _MAX_RETRIES:
        reason = "diverged" if segment.diverged else (segment.reason or "oscillates")
        raise CalibrationError(
            f"the loop does not stay closed: at an effective gain of {state.gain:.2f} it {reason}; "
            "lower loop.gain, drop more modes, or measure the matrix again"
        )
    state.gain *= _GAIN_REDUCTION
    state.notes.append(f"the loop was not stable; its gain was lowered to {state.gain:.3g}")
    loop.open_loop()
    loop.control.set_gain(state.gain)


def _progress(state: _BootstrapState) -> Progress:
    """The gains of all rounds so far."""
    gains, count = _applied(state), len(state.rounds)
    arrays = {"gains": gains.value, "gains_sigma": gains.sigma, "gains_smooth": gains.trend}
    if count:
        arrays["gains_rounds"] = np.stack([one.gains.best for one in state.rounds])
    small = {name: array.astype(np.float32) for name, array in arrays.items()}
    return Progress("optical gains", count, max(count, 1), "round", arrays=small)


def _is_accurate(measured: OpticalGainEstimate, target: float) -> bool:
    """Whether the relative error of the gains is below the target."""
    return _relative_error(_smooth(measured)) <= target


def _residual_is_high(segment: LoopSegment, state: _BootstrapState) -> bool:
    """Whether the residual is far above those of the first closure.

    The slopes of a pyramid saturate before the mirror does, so divergence is not detected by the limits.
    """
    known = [step.residual_nm for step in state.steps if step.stable and math.isfinite(step.residual_nm)]
    return bool(known) and segment.residual_nm > 1.5 * max(known)


def _record_round(
    loop: GainMeasurementLoop,
    segment: LoopSegment,
    measured: OpticalGainEstimate,
    amplitude: NDArray[np.float64],
    accuracy: float,
    model_psf: NDArray[np.float32] | None,
    state: _BootstrapState,
) -> None:
    """Append a round to the results and scale the matrix by its gains."""
    smoothed_gains, previous = _smooth(measured), _applied(state)
    change = smoothed_gains.best / clip_gains(previous) - 1
    expected = np.hypot(smoothed_gains.best_sigma / smoothed_gains.best, previous.best_sigma / previous.best)
    expected = np.hypot(expected, math.hypot(smoothed_gains.common_sigma, previous.common_sigma))
    state.rounds.append(
        GainRound(
            smoothed_gains, float(amplitude.max()), segment.frames, rms(change), rms(expected),
            segment.residual_nm, strehl_loss(amplitude, *_strehl_cost(loop, state)),
            _relative_error(smoothed_gains) <= accuracy, _strehl(segment, model_psf),
        )
    )  # fmt: skip
    _apply_gains(loop, state, smoothed_gains)


def _applied(state: _BootstrapState) -> OpticalGains:
    """The gains by which the matrix in use is scaled."""
    if state.applied is None:
        raise RuntimeError("no gains were measured yet")
    return state.applied


def _apply_gains(loop: GainMeasurementLoop, state: _BootstrapState, gains: OpticalGains) -> None:
    """Scale the matrix by the gains, so that the gain of the integrator is the effective one."""
    state.applied = gains
    loop.scale(clip_gains(gains))
    loop.control.set_gain(state.gain)


def _strehl(segment: LoopSegment, model_psf: NDArray[np.float32] | None) -> StrehlEstimate | None:
    """Strehl ratio of the science frames of a round; ``None`` if there are too few."""
    if model_psf is None or segment.record.science.count < MIN_SAMPLES:
        return None
    return strehl(segment.record.science.images(), model_psf)


def _smooth(measured: OpticalGainEstimate, reference: int = 0) -> OpticalGains:
    """Gains relative to one of the matrices of the loop, smoothed over the modes."""
    return smooth_over_modes(measured.value[reference], measured.sigma[reference], measured.common_sigma)


def _relative_error(gains: OpticalGains) -> float:
    """Relative standard error, rms over the modes."""
    return math.hypot(rms(gains.best_sigma / gains.best), gains.common_sigma)


def rms(values: NDArray[np.float64]) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(np.square(values))))


def _strehl_cost(loop: GainMeasurementLoop, state: _BootstrapState) -> tuple[float, float, float]:
    """Stroke [m], wavelength [m], and amplification of the variance of pokes by the loop."""
    bench = loop.bench
    delay = float(loop.reference.metrics.get("delay_frames", 2.0))
    factor = noise_gain(state.gain, bench.config.loop.leak, delay)
    return bench.dm.info.stroke_m, bench.config.system.wavelength_m, factor


def _save_partial_round(loop: GainMeasurementLoop, state: _BootstrapState) -> None:
    """Append an aborted round if it had enough frames; the loop is opened next."""
    measured = loop.solve_latest()
    if state.applied is None or measured is None:
        return
    smoothed_gains = _smooth(measured)
    change = smoothed_gains.best / clip_gains(state.applied) - 1
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
    closed_loop_matrix: InteractionMatrix | None,
    state: _BootstrapState,
    lost: int,
) -> GainsRun:
    rescaled_calibration, notes = calibration, list(state.notes)
    closed_loop_gains = state.comparisons.pop(_CLOSED_LOOP_MATRIX, None)
    if state.rounds and state.applied is not None:
        scaled, gains = calibration.matrix, state.applied
        # An aborted run may lack the gains of the closed-loop matrix.
        if closed_loop_matrix is not None and closed_loop_gains is not None:
            scaled, gains = closed_loop_matrix, closed_loop_gains
        sigma = np.hypot(gains.best_sigma, gains.best * gains.common_sigma)
        matrix = scale_matrix(scaled, clip_gains(gains), sigma)
        rescaled_calibration = replace(calibration, matrix=matrix, measured=None, partial=state.partial)
        if not state.rounds[-1].reached:
            notes.append("the last round ended at its number of frames, before the requested accuracy")
    result = GainsResult(
        calibration.matrix.method, tuple(state.rounds), tuple(state.steps), state.converged, state.gain,
        loop.frames, lost, state.comparisons, state.partial, tuple(notes),
    )  # fmt: skip
    return GainsRun(result, rescaled_calibration)
