"""Bootstrap of the optical gains (paper, PyWFS section).

Close the loop, measure the gains, rescale the matrix, and repeat with smaller pokes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.optical_gains import ClosureStep, GainRound, GainsResult, OpticalGains
from escape_hw.api.procedure import Procedure, Progress
from escape_hw.api.results import CalibrationResult
from escape_hw.bench import Bench
from escape_hw.calibration.acquisition.pokes import (
    compute_poke_amplitudes,
    noise_gain,
    scale_to_strehl_budget,
    strehl_loss,
)
from escape_hw.calibration.loop.divergence import is_above_stable
from escape_hw.calibration.optical_gain.estimator import GainMeasurementLoop, LoopSegment, OpticalGainEstimate
from escape_hw.calibration.optical_gain.loop_closure import bootstrap_loop
from escape_hw.calibration.optical_gain.matrix_comparison import scale_matrix
from escape_hw.calibration.optical_gain.smoothing import clip_gains, smooth_over_modes
from escape_hw.deprecation import renamed_keywords
from escape_hw.errors import Aborted, CalibrationError, ConfigError
from escape_hw.pipeline.psf.strehl import strehl
from escape_hw.pipeline.statistics import MIN_SAMPLES, root_mean_square

#: Poke of the first closure and the first round, and its factor from round to round.
_FIRST_POKE, _POKE_FACTOR = 0.004, 0.5
#: Largest relative loss of Strehl ratio due to the pokes before the last ones. Larger pokes, of many modes at
#: once, dominate the residual: the gains of a pyramid are then those for the pokes, and the loop appears not
#: to close.
_EARLY_STREHL_LOSS = 0.2
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


@renamed_keywords(beside="comparisons", shape="closed_loop_matrix", budget="allowed_strehl_loss")
def bootstrap_gains(
    bench: Bench,
    calibration: CalibrationResult,
    *,
    poke: float = 0.002,
    accuracy: float = 0.01,
    allowed_strehl_loss: float = 0.01,
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
    allowed_strehl_loss
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
    numbers = {
        "poke": poke, "accuracy": accuracy, "allowed_strehl_loss": allowed_strehl_loss, "gain": target_gain
    }  # fmt: skip
    for name, value in numbers.items():
        if not 0 < value < 1:
            raise ConfigError(f"{name} is {value}; it must lie between 0 and 1")
    all_comparisons = dict(comparisons or {})
    if closed_loop_matrix is not None:
        all_comparisons[_CLOSED_LOOP_MATRIX] = closed_loop_matrix
    loop = GainMeasurementLoop(bench, calibration, all_comparisons, science=model_psf is not None)
    bootstrap = _Bootstrap(loop, list(all_comparisons), target_gain, model_psf)
    with loop.closed():
        try:
            yield from bootstrap.close_and_scale_loop(poke)
            yield from bootstrap.run_rounds(poke, accuracy, allowed_strehl_loss, frames)
        except Aborted:
            bootstrap.save_partial_round()
    return bootstrap.build_run(calibration, closed_loop_matrix)


class _Bootstrap:
    """State and steps of a bootstrap in a closed loop."""

    def __init__(
        self,
        loop: GainMeasurementLoop,
        comparison_names: list[str],
        gain: float,
        model_psf: NDArray[np.float32] | None,
    ) -> None:
        self._loop, self._comparison_names, self._gain, self._model_psf = (
            loop,
            comparison_names,
            gain,
            model_psf,
        )
        #: The gains by which the matrix in use is scaled.
        self._applied: OpticalGains | None = None
        self._steps: list[ClosureStep] = []
        self._rounds: list[GainRound] = []
        self._comparisons: dict[str, OpticalGains] = {}
        self._notes: list[str] = []
        self._largest_amplitude = math.nan
        self._retries = 0
        self._converged = self._partial = False
        self._min_frames = max(_FRAMES_PER_MODE * loop.reference.n_modes, _MIN_FRAMES)

    def close_and_scale_loop(self, poke: float) -> Procedure[None]:
        """Close the loop at the effective gain, and scale its matrix by the measured gains."""
        loop = self._loop
        amplitude = self._limited_amplitude(max(poke, _FIRST_POKE), _EARLY_STREHL_LOSS)
        closure = yield from bootstrap_loop(loop, self._gain, amplitude, self._min_frames, self._steps)
        yield self._apply_gains(_smooth(closure.gains))

    def run_rounds(
        self, last_poke: float, last_accuracy: float, allowed_strehl_loss: float, max_frames: int
    ) -> Procedure[None]:
        """Measure and rescale with decreasing pokes until two rounds at the last poke agree.

        Raises :class:`CalibrationError` if the loop does not stay closed.
        """
        loop, poke, repeats = self._loop, max(last_poke, _FIRST_POKE), 0
        while repeats < _MAX_LAST_ROUNDS and not self._converged:
            is_last_poke = poke <= last_poke
            allowed = allowed_strehl_loss if is_last_poke else _EARLY_STREHL_LOSS
            amplitude = self._limited_amplitude(poke, allowed)
            self._largest_amplitude = float(amplitude.max())
            accuracy = last_accuracy * (1 if is_last_poke else _EARLY_ACCURACY_FACTOR)
            segment = yield from loop.measure(
                self._min_frames, amplitude,
                f"round {len(self._rounds) + 1}, poke {amplitude.max():.2g}", max_frames=max_frames,
                is_sufficient=partial(_is_accurate, target=accuracy),
            )  # fmt: skip
            stable_nm = [step.residual_nm for step in self._steps if step.stable]
            if segment.diverged or segment.gains is None or is_above_stable(segment.residual_nm, stable_nm):
                self._lower_gain(segment)
                continue
            last = self._record_round(segment, segment.gains, amplitude, accuracy)
            yield self._apply_gains(last.gains)
            is_confirmed = last.reached and last.change <= max(_TOLERANCE, 2 * last.expected_change)
            self._converged = is_last_poke and is_confirmed
            repeats += is_last_poke
            poke = max(last_poke, poke * _POKE_FACTOR)

    def _limited_amplitude(self, poke: float, allowed_strehl_loss: float) -> NDArray[np.float64]:
        """Amplitudes of the modes ``(n_modes,)`` for a poke, reduced to an allowed loss of Strehl ratio."""
        amplitude = compute_poke_amplitudes(self._loop.bench, self._loop.reference.m2c, poke)
        return scale_to_strehl_budget(amplitude, allowed_strehl_loss, *self._strehl_cost())

    def _lower_gain(self, segment: LoopSegment) -> None:
        """Open an unstable loop and reduce its gain; raises after :data:`_MAX_RETRIES` reductions."""
        self._retries += 1
        if self._retries > _MAX_RETRIES:
            reason = "it diverged" if segment.diverged else "it oscillates"
            if segment.reason and not segment.diverged:
                reason = f"no gains can be measured ({segment.reason})"
            raise CalibrationError(
                f"the loop does not stay closed: at an effective gain of {self._gain:.2f} {reason}; "
                "lower loop.gain, drop more modes, or measure the matrix again"
            )
        self._gain *= _GAIN_REDUCTION
        self._notes.append(f"the loop was not stable; its gain was lowered to {self._gain:.3g}")
        self._loop.open_loop()
        self._loop.control.set_gain(self._gain)

    def _record_round(
        self,
        segment: LoopSegment,
        measured: OpticalGainEstimate,
        amplitude: NDArray[np.float64],
        accuracy: float,
    ) -> GainRound:
        """Append a round to the results."""
        names = enumerate(self._comparison_names, 1)
        self._comparisons = {name: _smooth(measured, k) for k, name in names}
        gains, previous = _smooth(measured), self._previous_gains()
        expected = np.hypot(gains.best_sigma / gains.best, previous.best_sigma / previous.best)
        expected = np.hypot(expected, math.hypot(gains.common_sigma, previous.common_sigma))
        images = segment.record.science
        ratios = None
        if self._model_psf is not None and images.count >= MIN_SAMPLES:
            ratios = strehl(images.images(), self._model_psf)
        one = GainRound(
            gains, float(amplitude.max()), segment.frames,
            root_mean_square(gains.best / clip_gains(previous) - 1), root_mean_square(expected),
            segment.residual_nm, strehl_loss(amplitude, *self._strehl_cost()),
            _relative_error(gains) <= accuracy, ratios,
        )  # fmt: skip
        self._rounds.append(one)
        return one

    def _previous_gains(self) -> OpticalGains:
        if self._applied is None:
            raise RuntimeError("no gains were measured yet")
        return self._applied

    def _apply_gains(self, gains: OpticalGains) -> Progress:
        """Scale the matrix by the gains, so that the gain of the integrator is the effective one."""
        self._applied = gains
        self._loop.scale(clip_gains(gains))
        self._loop.control.set_gain(self._gain)
        arrays = {"gains": gains.value, "gains_sigma": gains.sigma, "gains_smooth": gains.trend}
        count = len(self._rounds)
        if count:
            arrays["gains_rounds"] = np.stack([one.gains.best for one in self._rounds])
        small = {name: array.astype(np.float32) for name, array in arrays.items()}
        return Progress("optical gains", count, max(count, 1), "round", arrays=small)

    def _strehl_cost(self) -> tuple[float, float, float]:
        """Stroke [m], wavelength [m], and amplification of the variance of pokes by the loop."""
        bench = self._loop.bench
        delay = float(self._loop.reference.metrics.get("delay_frames", 2.0))
        factor = noise_gain(self._gain, bench.config.loop.leak, delay)
        return bench.dm.info.stroke_m, bench.config.system.wavelength_m, factor

    def save_partial_round(self) -> None:
        """Append an aborted round if it had enough frames; the loop is opened next."""
        self._partial = True
        measured = self._loop.solve_latest()
        if self._applied is None or measured is None:
            return
        gains = _smooth(measured)
        change = root_mean_square(gains.best / clip_gains(self._applied) - 1)
        self._rounds.append(
            GainRound(
                gains, self._largest_amplitude, measured.frames, change, math.nan, math.nan, math.nan, False
            )
        )
        self._applied = gains

    def build_run(
        self, calibration: CalibrationResult, closed_loop_matrix: InteractionMatrix | None
    ) -> GainsRun:
        """The result, and the matrix scaled by its gains."""
        rescaled_calibration = calibration
        closed_loop_gains = self._comparisons.pop(_CLOSED_LOOP_MATRIX, None)
        if self._rounds and self._applied is not None:
            scaled, gains = calibration.matrix, self._applied
            # An aborted run may lack the gains of the closed-loop matrix.
            if closed_loop_matrix is not None and closed_loop_gains is not None:
                scaled, gains = closed_loop_matrix, closed_loop_gains
            sigma = np.hypot(gains.best_sigma, gains.best * gains.common_sigma)
            matrix = scale_matrix(scaled, clip_gains(gains), sigma)
            rescaled_calibration = replace(calibration, matrix=matrix, measured=None, partial=self._partial)
            if not self._rounds[-1].reached:
                self._notes.append(
                    "the last round ended at its number of frames, before the requested accuracy"
                )
        result = GainsResult(
            calibration.matrix.method, tuple(self._rounds), tuple(self._steps), self._converged, self._gain,
            self._loop.frames, self._loop.lost_frames, self._comparisons, self._partial, tuple(self._notes),
        )  # fmt: skip
        return GainsRun(result, rescaled_calibration)


def _smooth(measured: OpticalGainEstimate, reference: int = 0) -> OpticalGains:
    """Gains relative to one of the matrices of the loop, smoothed over the modes."""
    return smooth_over_modes(measured.value[reference], measured.sigma[reference], measured.common_sigma)


def _is_accurate(measured: OpticalGainEstimate, target: float) -> bool:
    return _relative_error(_smooth(measured)) <= target


def _relative_error(gains: OpticalGains) -> float:
    """Relative standard error, rms over the modes."""
    return math.hypot(root_mean_square(gains.best_sigma / gains.best), gains.common_sigma)
