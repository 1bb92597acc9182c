"""Live registration: one Gauss-Newton update of SPRINT per block of closed-loop telemetry.

The updates use sums of the whitened telemetry with exponential forgetting
(:class:`~escape_hw.calibration.docrime.regression.ForgettingSums`), start from the last estimate, and have
the unknowns of a full fit: gain, registration, random effects, and on a pyramid the optical gains as a
smooth curve over the modes. Double exponential smoothing (:class:`DoubleExponentialSmoother`) removes the
lag of the memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.results import Estimate, RegistrationEstimate, TemporalResponse
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.acquisition.aligned_telemetry import AlignedTelemetry
from escape_hw.calibration.docrime.regression import ForgettingSums, whiten_columns
from escape_hw.calibration.docrime.response import FilteredTelemetry, ResponseAccumulator, filter_telemetry
from escape_hw.calibration.optical_gain.smoothing import compute_command_curves, gain_curve_basis
from escape_hw.calibration.sprint.covariance import sandwich_covariance, systematic_error
from escape_hw.calibration.sprint.extra_parameters import build_fitted_extra_parameters, priors_from_fit
from escape_hw.calibration.sprint.mixed_effects import (
    GAIN,
    WIDTH,
    MixedEffectsProblem,
    MixedEffectsState,
)
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors
from escape_hw.calibration.sprint.numbering import numbering_covariance
from escape_hw.calibration.sprint.synthetic_matrix import FittedMatrix, compute_fitted_jacobian
from escape_hw.calibration.sprint.telemetry_fit import fit_whitener
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix, apply_model_weights
from escape_hw.errors import TooFewFrames

#: Prior standard deviation of the drift per second: relative gain, registration; coefficients of the curve.
_DRIFT_SIGMA = np.array([0.05, 0.5, 0.5, 0.02, 0.1, 0.1])
_CURVE_DRIFT_SIGMA = 0.1
#: Gauss-Newton steps of the first update, and largest step of the registration.
_FIRST_ITERATIONS, _MAX_STEP = 5, np.array([60.0, 60.0, 2.0, 4.0, 4.0])
#: Smallest prior standard deviation of the width of the influence functions.
_MIN_WIDTH_SIGMA = 0.005
#: Updates between two estimates of the whitening filter.
_WHITEN_EVERY = 15
#: Smallest number of whitened frames of an update.
_MIN_FRAMES = 50
#: Innovations from which their running variance is learned before one is judged, and weight of a later one.
_MIN_INNOVATIONS, _LEARNING_RATE = 4, 0.15
#: Squared mean innovation, relative to the variance of its noise, above which it counts as curvature.
_BIAS_THRESHOLD = 3.0
#: Limit of a squared innovation over its running variance, so that a jump hardly changes that.
_MAX_INNOVATION = 36.0


@dataclass(frozen=True, slots=True, eq=False)
class LiveEstimate:
    """Result of an update, for the present time.

    Parameters
    ----------
    registration
        Registration and gain, corrected for the lag of the memory, with standard errors.
    change_covariance
        Covariance of a change of the registration ``(5, 5)``, without errors that are constant in time.
    gains, gains_sigma
        Gain of every mode ``(n_modes,)``, with the standard error of a change: :attr:`matrix` projected on
        the synthetic model, so it includes the effects of slopes, and of actuators beyond the corrections.
    innovation
        Largest difference between the data of this update and their prediction, in standard errors.
    misfit
        Mean square residual of the data of this update, in units of their noise: 1 if the model explains
        them.
    noise
        Rms of a whitened slope in this block, without the contribution of the commands.
    actuator_gains, actuator_gain_changes
        Relative gain of every actuator beyond the common one, and its change since the calibration
        ``(n_act,)``.
    matrix
        The fitted matrix, random effects included ``(n_slopes, n_modes)``.
    fitted
        Matrix of the calibration's mirror at this registration.
    """

    registration: RegistrationEstimate
    change_covariance: NDArray[np.float64]
    gains: NDArray[np.float64]
    gains_sigma: NDArray[np.float64]
    innovation: float
    misfit: float
    noise: float
    actuator_gains: NDArray[np.float64]
    actuator_gain_changes: NDArray[np.float64]
    matrix: NDArray[np.float64]
    fitted: FittedMatrix
    response: TemporalResponse


def count_history_rows(order: int, lags: int) -> int:
    """Rows of history that filters of this length need before the first new row of a block."""
    return 2 * order + lags


class LiveRegistration:
    """Tracks a registration through blocks of closed-loop telemetry.

    Parameters
    ----------
    template
        The matrix in use, of which mask and basis are used, and for the first update the data.
    model
        The synthetic model on the same sub-apertures.
    start
        Initial registration, within the linear range of SPRINT. Small pokes hardly determine the width of
        the influence functions, so it is a prior, as are the fitted extra parameters. The scatter of
        actuators and slopes is estimated from the blocks. The actuator corrections are those of the matrices
        at the live registration.
    order, lags
        Order of the whitening filter and length of the temporal response, in frames.
    memory_s
        Seconds after which the weight of a frame is ``1 / e``; infinite: no forgetting.
    n_curve_coefficients
        Coefficients of the curve of optical gains over the modes; 0: one gain for all modes.
    """

    def __init__(
        self,
        template: InteractionMatrix,
        model: SyntheticModel,
        start: RegistrationEstimate,
        *,
        order: int,
        lags: int,
        memory_s: float = 10.0,
        n_curve_coefficients: int = 0,
        response: TemporalResponse | None = None,
    ) -> None:
        self._template, self._model, self._start = template, model, start.registration
        scatter = min(Priors().width, max(start.width.sigma, _MIN_WIDTH_SIGMA))
        self._extras = build_fitted_extra_parameters(model, start.extras)
        extras = priors_from_fit(self._extras, start.extras)
        # Small pokes hardly determine shape and single actuators: those of the calibration are the prior
        # means, and what it does not know of the mirror is unknown to all updates.
        self._actuator_corrections = start.actuator_corrections
        self._priors = Priors(
            width=scatter, mean_width=start.width.value - 1, actuators=start.actuator_corrections,
            extras=extras,
        )  # fmt: skip
        self._constant_covariance = numbering_covariance(model)
        if start.actuator_corrections is not None:
            between_runs = start.repeatability_covariance
            unknown = start.covariance - (0.0 if between_runs is None else between_runs)
            self._constant_covariance = self._constant_covariance + _without_negative_variances(unknown)
        self._influence_profile = start.influence_profile
        self._order, self._lags, self._response = order, lags, response
        self._basis = gain_curve_basis(template.n_modes, n_curve_coefficients)
        self._command_curves = compute_command_curves(template.m2c, self._basis)
        self._memory_s = memory_s
        drift_sigma = np.concatenate([_DRIFT_SIGMA, np.full(n_curve_coefficients, _CURVE_DRIFT_SIGMA)])
        self._drift_line = DoubleExponentialSmoother(memory_s, drift_sigma)
        # Fitted matrix at the mean age of the sums, and extrapolated to the present.
        self._matrix = self._current_matrix = template.data.astype(np.float64)
        self._problem: MixedEffectsProblem | None = None
        self.restart()

    def restart(self) -> None:
        """Discard all frames; the next update starts from the last estimate."""
        self._sums = ForgettingSums.zeros(*self._template.data.shape)
        self._weights = ResponseAccumulator(self._lags)
        self._whitener: NDArray[np.float64] | None = None
        self._state: MixedEffectsState | None = None
        self._updates = 0
        self._drift_line.restart()

    def update(self, data: AlignedTelemetry, start: int = 0, seconds: float = 1.0) -> LiveEstimate:
        """Estimate the registration with one more block of frames.

        ``data``: closed-loop telemetry: slopes, total modal commands, and the pokes in them; ``start``: first
        new row, after :func:`count_history_rows` rows of history; ``seconds``: duration of the new rows.

        Raises
        ------
        TooFewFrames
            Too few frames with a known history.
        """
        learning = self._updates < 2 or self._updates % _WHITEN_EVERY == 0
        if learning:
            self._whiten(data, start)
        block = self._filter_block(data, start)
        self._weights.add(block, self._current_matrix)
        response = self._weights.response(self._response)
        delayed = block.excitation(response.weights)
        if self._state is None:
            # The residual for the matrix in use includes its error: fit once for the noise.
            self._add_block(block, delayed, seconds)
            problem, system, self._state = self._gauss_newton()
            self._priors = _estimate_priors(problem, self._state, system)
            self._current_matrix, self._sums = self._matrix, ForgettingSums.zeros(*self._template.data.shape)
        block_sums = self._add_block(block, delayed, seconds)
        problem, system, self._state = self._gauss_newton()
        self._updates += 1
        present = self._extrapolate_to_now(problem, system, self._state, seconds)
        found = self._build_estimate(problem, system, self._state, present, block_sums, response)
        if learning:
            self._priors = _estimate_priors(problem, self._state, system)
        return found

    def _add_block(
        self, block: FilteredTelemetry, delayed: NDArray[np.float32], seconds: float
    ) -> ForgettingSums:
        """Forget for the duration of a block, add it, and return the sums of the block alone."""
        n_modes = self._template.n_modes
        block_sums = ForgettingSums.zeros(*self._template.data.shape)
        block_sums.add(
            block.slopes, delayed[:, :n_modes], delayed[:, n_modes:], self._current_matrix.astype(np.float32)
        )
        self._sums.forget(math.exp(-seconds / self._memory_s))
        self._sums.merge(block_sums)
        return block_sums

    def _whiten(self, data: AlignedTelemetry, start: int) -> None:
        """Estimate the whitening filter, and the first time the response as well, from a block."""
        first = self._whitener is None
        if first:
            self._whitener = np.array([1.0, -1.0]) if self._order else np.ones(1)
        n_modes = self._template.n_modes
        if first and self._response is None:
            sums = ResponseAccumulator(self._lags)
            sums.add(self._filter_block(data, start), self._current_matrix)
            self._response = sums.response(None)
        if self._order:
            response = self._weights.response(self._response)
            commands = AlignedTelemetry(data.rows[:, :-n_modes], data.present, data.n_slopes)
            self._whitener = fit_whitener(commands, self._current_matrix, response, self._order, self._lags)

    def _filter_block(self, data: AlignedTelemetry, start: int) -> FilteredTelemetry:
        if self._whitener is None:
            raise RuntimeError("the whitening filter has not been estimated")
        block = filter_telemetry(data, self._whitener, self._lags, start)
        if len(block.now) < _MIN_FRAMES:
            raise TooFewFrames(
                f"{len(block.now)} frames with a known history are too few for an update; "
                f"at least {_MIN_FRAMES} are needed"
            )
        return block

    def _gauss_newton(self) -> tuple[MixedEffectsProblem, NormalEquations, MixedEffectsState]:
        """Gauss-Newton on the sums: one step, or several for the first update."""
        state = self._state
        for _ in range(_FIRST_ITERATIONS if state is None else 1):
            columns = self._sums.build_columns(self._template, self._matrix)
            weighted = WeightedMatrix.from_columns(columns, np.arange(columns.n_modes))
            weighted = apply_model_weights(weighted, self._model)
            self._problem = problem = MixedEffectsProblem(
                weighted, self._model, self._priors, self._command_curves, self._extras, self._problem,
                follow=True,
            )  # fmt: skip
            state = state or problem.initial_state(self._start)
            system = problem.linearise(state)
            step = system.solve()
            largest_ratio = float(np.max(np.abs(step[1:6]) / _MAX_STEP))
            state = problem.move(state, step / max(largest_ratio, 1.0))
            self._matrix = problem.matrix(state, self._template.m2c)
        if state is None:
            raise RuntimeError("no step was made")
        return problem, system, state

    def _build_estimate(
        self,
        problem: MixedEffectsProblem,
        system: NormalEquations,
        state: MixedEffectsState,
        present: SmoothedState,
        block_sums: ForgettingSums,
        response: TemporalResponse,
    ) -> LiveEstimate:
        value = present.value
        current_variants = np.concatenate([state.variant[: _first_curve_index(problem)], value[6:]])
        current_state = replace(state, gain=float(value[GAIN]), alpha=value[1:6], variant=current_variants)
        self._current_matrix = problem.matrix(current_state, self._template.m2c)
        self._start = Registration.from_array(value[1:6])
        columns = whiten_columns(
            self._template, block_sums.cross, block_sums.command_poke_products, block_sums.gram,
            self._sums.variance,
        )  # fmt: skip
        residual = columns.data - self._current_matrix @ np.linalg.lstsq(self._template.m2c, columns.m2c)[0]
        residual /= columns.sigma
        gain, timing_sigma = present.value[GAIN], value[GAIN] * self._weights.gain_sigma(response)
        gain_sigma = float(np.hypot(np.sqrt(present.covariance[GAIN, GAIN]), timing_sigma))
        sigma = np.sqrt(np.diag(np.linalg.inv(system.information())))
        estimate = RegistrationEstimate(
            Registration.from_array(present.value[1:6]),
            present.covariance[1:6, 1:6] + self._constant_covariance,
            Estimate(float(gain), gain_sigma),
            Estimate(1 + state.width, float(sigma[WIDTH])),
            True,
            (),
            float(np.mean(np.square(system.residual))),
            actuator_corrections=self._actuator_corrections,
            extras={
                one.model.name: one.to_estimate(sigma, systematic_error(self._model))
                for one in problem.extra_parameter_values(state)
            },
            repeatability_covariance=present.random_covariance[1:6, 1:6],
            influence_profile=self._influence_profile,
        )
        fitted = compute_fitted_jacobian(self._model, estimate, self._template.m2c, problem.shape)
        unit = fitted.unit
        gains = np.asarray((self._current_matrix * unit).sum(axis=0) / np.square(unit).sum(axis=0))
        return LiveEstimate(
            estimate, present.random_covariance[1:6, 1:6], gains, self._gains_sigma(present, timing_sigma),
            float(np.abs(present.innovation).max()), float(np.mean(np.square(residual))),
            float(np.sqrt(block_sums.variance.mean())), state.actuator_gain.copy(),
            problem.actuator_gain_changes(state), self._current_matrix, fitted, response,
        )  # fmt: skip

    def _extrapolate_to_now(
        self,
        problem: MixedEffectsProblem,
        system: NormalEquations,
        state: MixedEffectsState,
        seconds: float,
    ) -> SmoothedState:
        """Gain, registration and curve at the present time, without the lag of the memory."""
        first_curve = _first_curve_index(problem)
        first_curve_index = problem.first_variant + first_curve
        selected = np.r_[0:6, first_curve_index : first_curve_index + len(self._command_curves)]
        total_covariance = sandwich_covariance(problem.weighted, system, self._sums.covariance)
        total_covariance = total_covariance[np.ix_(selected, selected)]
        noise = system.noise_covariance(problem.precision)[np.ix_(selected, selected)]
        total_covariance[np.arange(1, 6), np.arange(1, 6)] += np.square(systematic_error(self._model))
        static = _without_negative_variances(total_covariance - noise)
        values = np.concatenate([[state.gain], state.alpha, state.variant[first_curve:]])
        return self._drift_line.update(values, noise, static, seconds)

    def _gains_sigma(self, present: SmoothedState, timing_sigma: float) -> NDArray[np.float64]:
        """Standard error of the gain of every mode, from those of the common gain and the curve."""
        gain = present.value[GAIN]
        relative = 1 + present.value[6:] @ self._basis
        jacobian = np.concatenate([relative[None], np.zeros((5, relative.size)), gain * self._basis])
        covariance = present.random_covariance.copy()
        covariance[GAIN, GAIN] += timing_sigma**2
        variance = np.einsum("pm,pq,qm->m", jacobian, covariance, jacobian)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _estimate_priors(
    problem: MixedEffectsProblem, state: MixedEffectsState, system: NormalEquations
) -> Priors:
    """Scatter of the effects; that of the gains of actuators at least as usual, since any may fail."""
    priors = problem.estimate_priors(state, system).priors
    return replace(priors, actuator_gain=max(priors.actuator_gain, Priors().actuator_gain))


def _without_negative_variances(matrix: NDArray[np.float64]) -> NDArray[np.float64]:
    """A difference of covariances ``(n, n)`` without the directions in which it is negative."""
    eigenvalues, directions = np.linalg.eigh(matrix)
    return np.asarray((directions * np.maximum(eigenvalues, 0.0)) @ directions.T)


def _first_curve_index(problem: MixedEffectsProblem) -> int:
    """Number of shares before those of the gain curve: of variants and extra parameters."""
    return problem.n_variants - len(problem.command_curves)


def scale_to_live_gains(matrix: InteractionMatrix, live: LiveEstimate) -> InteractionMatrix:
    """A pseudo-synthetic matrix with the live gain of each mode in place of the common gain."""
    ratio = live.gains / live.registration.gain.value
    return replace(matrix, data=(matrix.data * ratio).astype(np.float32), sigma=matrix.sigma * np.abs(ratio))


@dataclass(frozen=True, slots=True, eq=False)
class SmoothedState:
    """Linear extrapolation to the present time.

    Parameters
    ----------
    value, rate
        Level ``(n,)`` and change per second ``(n,)``.
    covariance, random_covariance
        Covariance of the level ``(n, n)``, and its part that is independent from update to update.
    innovation
        Data of the last update minus their prediction ``(n,)``, in standard errors scaled to those of the
        recent updates; zero while there are too few of them.
    """

    value: NDArray[np.float64]
    rate: NDArray[np.float64]
    covariance: NDArray[np.float64]
    random_covariance: NDArray[np.float64]
    innovation: NDArray[np.float64]


class DoubleExponentialSmoother:
    """Removes the lag of exponentially forgotten estimates of several parameters.

    The estimate from exponentially forgotten sums is the mean of the true values over the memory, of age
    ``A``. The same mean taken over those estimates has a larger age ``B``. For a linear drift the present
    value is ``S + A (S - T) / (B - A)``, with ``S`` the first mean and ``T`` the second (Brown 1963, double
    exponential smoothing, with the ages as they are while the memory fills).

    Parameters
    ----------
    memory_s
        Seconds after which the weight of an update is ``1 / e``; infinite: no forgetting.
    max_rate
        Prior standard deviation of the drift per second ``(n,)``, relevant while the memory fills.
    """

    def __init__(self, memory_s: float, max_rate: NDArray[np.float64]) -> None:
        self._memory_s, self._max_rate = memory_s, np.asarray(max_rate, float)
        # Number and running variance of the innovations; survive a restart.
        self._n_innovations = 0
        self._innovation_variance = np.ones(len(self._max_rate))
        self.restart()

    def restart(self) -> None:
        """Discard all updates."""
        n = len(self._max_rate)
        self._weight = 0.0
        self._mean, self._second = np.zeros(n), np.zeros(n)
        # Durations of the updates, and weights of the noise of each in both means, the oldest first.
        self._durations = np.zeros(0)
        self._first_shares, self._second_shares = np.zeros(0), np.zeros(0)
        # Value, rate and variance of the last update.
        self._last: tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]] | None = None
        self._mean_innovation, self._curvature_variance = np.zeros(n), np.zeros(n)

    def update(
        self,
        mean: NDArray[np.float64],
        noise: NDArray[np.float64],
        static: NDArray[np.float64],
        seconds: float = 1.0,
    ) -> SmoothedState:
        """Add the estimate from the forgotten sums.

        ``mean``: the estimate ``(n,)``; ``noise``, ``static``: covariances ``(n, n)`` of its noise,
        independent from frame to frame, and of its constant errors; ``seconds``: duration of the new data.
        """
        self._weight = math.exp(-seconds / self._memory_s) * self._weight + seconds
        share = seconds / self._weight
        new_estimate = self._mean + (mean - self._mean) / share
        self._durations = np.append(self._durations, seconds)
        self._first_shares = np.append(self._first_shares * (1 - share), share)
        self._second_shares = np.append(self._second_shares * (1 - share), 0) + share * self._first_shares
        self._mean, self._second = mean, self._second + share * (mean - self._second)
        first, second, durations = self._first_shares, self._second_shares, self._durations
        ages = np.cumsum(durations[::-1])[::-1] - durations / 2
        first_age, second_age = float(first @ ages), float(second @ ages)
        # The noise of an update falls with its duration.
        noise_of_a_second = noise / float(first @ (first / durations))
        value, rate, variance = mean, np.zeros_like(mean), np.square(first_age * self._max_rate)
        shares = np.broadcast_to(first, (len(mean), len(first)))
        if second_age > first_age:
            unshrunk_rate = (mean - self._second) / (second_age - first_age)
            rate_variance = np.diag(noise_of_a_second) * float((np.square(first - second) / durations).sum())
            rate_variance = rate_variance / (second_age - first_age) ** 2
            shrinkage = np.square(self._max_rate) / (np.square(self._max_rate) + rate_variance)
            rate = shrinkage * unshrunk_rate
            value = mean + first_age * rate
            shares = first + (shrinkage * first_age / (second_age - first_age))[:, None] * (first - second)
            variance = np.square(first_age * self._max_rate * (1 - shrinkage))
        random_covariance = noise_of_a_second * ((shares / durations) @ shares.T) + np.diag(variance)
        raw_innovation, curvature_variance = self._compute_innovation(
            new_estimate, noise_of_a_second / seconds, seconds
        )
        innovation = self._judge_innovation(raw_innovation)
        error_scale = np.sqrt(np.maximum(self._innovation_variance, 1.0))
        random_covariance = random_covariance * np.outer(error_scale, error_scale)
        random_covariance = random_covariance + np.diag(curvature_variance)
        self._last = value, rate, np.diag(random_covariance)
        self._trim()
        return SmoothedState(value, rate, static + random_covariance, random_covariance, innovation)

    def _judge_innovation(self, raw_innovation: NDArray[np.float64]) -> NDArray[np.float64]:
        """Innovation in units of the scatter of recent ones, to which it is added.

        Where the response varies with the wavefronts, as on a pyramid, estimates of single seconds scatter
        more than the noise of the frames tells. How much is not known before there are a few of them.
        """
        if self._last is None:
            return raw_innovation
        variance = np.maximum(self._innovation_variance, 1.0)
        judged = self._n_innovations >= _MIN_INNOVATIONS
        limit = _MAX_INNOVATION * variance if judged else np.inf
        self._n_innovations += 1
        share = max(_LEARNING_RATE, 1 / (1 + self._n_innovations))
        self._innovation_variance += share * (
            np.minimum(np.square(raw_innovation), limit) - self._innovation_variance
        )
        return np.asarray(raw_innovation / np.sqrt(variance) if judged else np.zeros_like(raw_innovation))

    def _compute_innovation(
        self, new_estimate: NDArray[np.float64], covariance: NDArray[np.float64], seconds: float
    ) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Innovation in standard errors, and variance due to a curvature of the drift.

        A curved drift makes the innovations of successive updates have the same sign: the square of their
        running mean beyond its noise is added to the variance, and decays slowly, because an oscillation
        turns round.
        """
        if self._last is None:
            return np.zeros_like(new_estimate), np.zeros_like(new_estimate)
        value, rate, variance = self._last
        noise = np.diag(covariance) + variance
        # The new data have a mean age of half their duration.
        raw_innovation = new_estimate - (value + 0.5 * seconds * rate)
        self._mean_innovation += _LEARNING_RATE * (raw_innovation - self._mean_innovation)
        threshold = _BIAS_THRESHOLD * noise * _LEARNING_RATE / (2 - _LEARNING_RATE)
        excess = np.square(self._mean_innovation) - threshold
        self._curvature_variance = np.maximum(excess, self._curvature_variance * (1 - _LEARNING_RATE / 2))
        sigma = np.sqrt(noise + np.square(seconds * self._max_rate))
        return raw_innovation / sigma, self._curvature_variance

    def _trim(self) -> None:
        """Drop the oldest weights once they are negligible."""
        if self._durations.sum() > 40 * self._memory_s:
            half = len(self._durations) // 2
            self._durations = self._durations[half:]
            self._first_shares = self._first_shares[half:]
            self._second_shares = self._second_shares[half:]
