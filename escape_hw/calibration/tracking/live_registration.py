"""A registration every second, from small pokes in a loop that keeps running.

Sums over the whitened telemetry fade with a memory of some seconds (:mod:`~.fading_sums`); every update
is one Gauss-Newton step of SPRINT on them from the last estimate, with the same unknowns as a full fit:
gain, registration, what the model does not know, and on a pyramid the optical gains as a smooth curve
over the modes. A straight line through the estimates (:mod:`~.straight_line`) takes out their lag.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.results import Estimate, RegistrationEstimate, TemporalResponse
from escape_hw.api.synthetic_model import HasSystematicError, SyntheticModel
from escape_hw.calibration.acquisition.telemetry import AlignedTelemetry
from escape_hw.calibration.docrime.regression import ForgettingSums, whiten_columns
from escape_hw.calibration.docrime.response import FilteredTelemetry, ResponseAccumulator, filter_telemetry
from escape_hw.calibration.optical_gain.smoothing import compute_command_curves, gain_curve_basis
from escape_hw.calibration.sprint.covariance import sandwich_covariance
from escape_hw.calibration.sprint.extra_parameters import build_fitted_extra_parameters, priors_from_fit
from escape_hw.calibration.sprint.mixed_effects import (
    GAIN,
    SHAPE,
    WIDTH,
    MixedEffectsProblem,
    MixedEffectsState,
)
from escape_hw.calibration.sprint.normal_equations import NormalEquations, Priors
from escape_hw.calibration.sprint.slope_weights import apply_model_weights
from escape_hw.calibration.sprint.synthetic_matrix import compute_fitted_matrix
from escape_hw.calibration.sprint.telemetry_fit import fit_whitener
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
from escape_hw.calibration.tracking.smoothing import DoubleExponentialSmoother, SmoothedState
from escape_hw.errors import TooFewFrames

#: Drift per second that is nothing unusual: relative gain, registration, coefficients of the gains' curve.
_DRIFT_SIGMA = np.array([0.05, 0.5, 0.5, 0.02, 0.1, 0.1])
_CURVE_DRIFT_SIGMA = 0.1
#: Gauss-Newton steps of the first update, and largest step in standard deviations of what is usual.
_FIRST_ITERATIONS, _MAX_STEP = 5, np.array([60.0, 60.0, 2.0, 4.0, 4.0])
#: Least error of a width that is taken over.
_MIN_WIDTH_SIGMA = 0.005
#: Updates after which the whitening filter is found anew, again and again.
_WHITEN_EVERY = 15
#: Whitened frames without which no update is made.
_MIN_FRAMES = 50


@dataclass(frozen=True, slots=True, eq=False)
class LiveEstimate:
    """What an update says of the present.

    Parameters
    ----------
    registration
        Registration and gain, freed of the memory's lag, with errors.
    change
        Covariance of the registration ``(5, 5)`` without what errs alike at all times: that of a change.
    gains, gains_sigma
        Gain of every mode ``(n_modes,)``: :attr:`matrix` projected on the synthetic model, so what slopes
        take from a mode is in it, and what actuators take beyond the departures; and its error as a change.
    rate
        Drift per second ``(6,)``: gain, then the registration.
    surprise
        By how many standard errors the update's own frames missed what was expected, the worst of all.
    misfit
        Mean square of what the update's own frames leave of the model, in units of their noise: 1 if the
        model explains them.
    noise
        Rms of a whitened slope that neither pokes nor controller explain, in the update's own frames.
    actuators
        Relative gain of every actuator beyond the common one ``(n_act,)``.
    matrix
        Everything fitted, random effects included ``(n_slopes, n_modes)``: what the loop really sees.
    response
        Temporal response.
    """

    registration: RegistrationEstimate
    change: NDArray[np.float64]
    gains: NDArray[np.float64]
    gains_sigma: NDArray[np.float64]
    rate: NDArray[np.float64]
    surprise: float
    misfit: float
    noise: float
    actuator_gains: NDArray[np.float64]
    matrix: NDArray[np.float64]
    response: TemporalResponse


class LiveRegistration:
    """Follows a registration through blocks of telemetry.

    Parameters
    ----------
    frame
        The matrix that the loop runs with; its mask and basis are used, and its data to begin with.
    model
        The synthetic model on the same sub-apertures.
    start
        Registration to start from, within SPRINT's linear reach. Its width of the influence functions,
        which small pokes hardly show, is taken over with its error, and so are a shear or shifted images
        where it tells of them; what it says of single actuators is what a matrix at the live registration
        will have.
    order, lags
        Of the whitening filter and the temporal response, in frames.
    memory
        Updates after which a frame counts ``1 / e``; infinite: nothing is forgotten.
    step_s
        Seconds between updates.
    curved
        Coefficients of the optical gains' curve over the modes; 0: one gain for all.
    response
        Temporal response, where it is known.
    """

    def __init__(
        self,
        template: InteractionMatrix,
        model: SyntheticModel,
        start: RegistrationEstimate,
        *,
        order: int,
        lags: int,
        memory: float = 10.0,
        step_s: float = 1.0,
        n_curve_coefficients: int = 0,
        response: TemporalResponse | None = None,
    ) -> None:
        self._template, self._model, self._start = template, model, start.registration
        scatter = min(Priors().width, max(start.width.sigma, _MIN_WIDTH_SIGMA))
        self._extras = build_fitted_extra_parameters(model, start.extras)
        self._priors = Priors(
            width=scatter,
            mean_width=start.width.value - 1,
            extras=priors_from_fit(self._extras, start.extras),
        )
        # Small pokes tell little of single actuators: what the calibration found of them stays.
        self._actuator_corrections = start.actuator_corrections
        self._order, self._lags, self._response = order, lags, response
        self._basis = gain_curve_basis(template.n_modes, n_curve_coefficients)
        self._command_curves = compute_command_curves(template.m2c, self._basis)
        self._forgetting_factor = float(np.exp(-1 / memory))
        drift_sigma = np.concatenate([_DRIFT_SIGMA, np.full(n_curve_coefficients, _CURVE_DRIFT_SIGMA)])
        self._drift_line = DoubleExponentialSmoother(
            self._forgetting_factor if self._forgetting_factor < 1 else 1 - 1e-9, step_s, drift_sigma
        )
        # At the mean age of the sums, and now.
        self._matrix = self._current_matrix = template.data.astype(np.float64)
        self.restart()

    def restart(self) -> None:
        """Forget all frames; the last estimate is where the next one starts from."""
        self._sums = ForgettingSums.zeros(*self._template.data.shape)
        self._weights = ResponseAccumulator(self._lags)
        self._whitener: NDArray[np.float64] | None = None
        self._state: MixedEffectsState | None = None
        self._updates = 0
        self._drift_line.restart()

    @property
    def memory_rows(self) -> int:
        """Rows before a block's first new one that its filtered rows are made of."""
        return 2 * self._order + self._lags

    def update(self, data: AlignedTelemetry, start: int = 0) -> LiveEstimate:
        """Take a block of frames and say where the mirror sits.

        Parameters
        ----------
        data
            Of a closed loop: slopes, total modal commands, and the pokes in them.
        start
            First new row; the :attr:`memory_rows` before it are the past of the new ones.

        Raises
        ------
        TooFewFrames
            Hardly a frame whose past is known.
        """
        if self._updates < 2 or self._updates % _WHITEN_EVERY == 0:
            self._whiten(data, start)
        block = self._filtered(data, start)
        self._weights.add(block, self._current_matrix)
        response = self._weights.response(self._response)
        delayed = block.excitation(response.weights)
        if self._state is None:
            # The residual by the matrix in use is not the noise yet: fit once for a better one.
            self._add_block(block, delayed)
            self._state = self._gauss_newton()[2]
            self._current_matrix, self._sums = self._matrix, ForgettingSums.zeros(*self._template.data.shape)
        block_sums = self._add_block(block, delayed)
        problem, system, self._state = self._gauss_newton()
        self._updates += 1
        return self._build_estimate(problem, system, self._state, block_sums, response)

    def _add_block(self, block: FilteredTelemetry, delayed: NDArray[np.float32]) -> ForgettingSums:
        """Let the sums fade and add a block; the block's own sums."""
        n_modes = self._template.n_modes
        block_sums = ForgettingSums.zeros(*self._template.data.shape)
        block_sums.add(
            block.slopes, delayed[:, :n_modes], delayed[:, n_modes:], self._current_matrix.astype(np.float32)
        )
        self._sums.forget(self._forgetting_factor)
        self._sums.merge(block_sums)
        return block_sums

    def _whiten(self, data: AlignedTelemetry, start: int) -> None:
        """Find the filter, and the first time the response as well, on a block."""
        first = self._whitener is None
        if first:
            self._whitener = np.array([1.0, -1.0]) if self._order else np.ones(1)
        n_modes = self._template.n_modes
        if first and self._response is None:
            sums = ResponseAccumulator(self._lags)
            sums.add(self._filtered(data, start), self._current_matrix)
            self._response = sums.response(None)
        if self._order:
            response = self._weights.response(self._response)
            commands = AlignedTelemetry(data.rows[:, :-n_modes], data.present, data.n_slopes)
            self._whitener = fit_whitener(commands, self._current_matrix, response, self._order, self._lags)

    def _filtered(self, data: AlignedTelemetry, start: int) -> FilteredTelemetry:
        if self._whitener is None:
            raise RuntimeError("the filter comes first")
        block = filter_telemetry(data, self._whitener, self._lags, start)
        if len(block.now) < _MIN_FRAMES:
            raise TooFewFrames(
                f"{len(block.now)} frames whose past is known are too few for an update; "
                f"at least {_MIN_FRAMES} are needed"
            )
        return block

    def _gauss_newton(self) -> tuple[MixedEffectsProblem, NormalEquations, MixedEffectsState]:
        """Gauss-Newton on the sums: one step, or several the first time."""
        state = self._state
        for _ in range(_FIRST_ITERATIONS if state is None else 1):
            columns = self._sums.build_columns(self._template, self._matrix)
            weighted = apply_model_weights(
                WeightedMatrix.of(columns, np.arange(columns.n_modes)), self._model
            )
            problem = MixedEffectsProblem(
                weighted, self._model, self._priors, self._command_curves, self._extras
            )
            state = state or problem.start(self._start)
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
        block_sums: ForgettingSums,
        response: TemporalResponse,
    ) -> LiveEstimate:
        present = self._extrapolate_to_now(problem, system, state)
        value = present.value
        current_variants = np.concatenate([state.variant[: _first_curve_index(problem)], value[6:]])
        current_state = replace(state, gain=float(value[GAIN]), alpha=value[1:6], variant=current_variants)
        self._current_matrix = problem.matrix(current_state, self._template.m2c)
        self._start = Registration.from_array(value[1:6])
        columns = whiten_columns(
            self._template,
            block_sums.cross,
            block_sums.command_poke_products,
            block_sums.gram,
            self._sums.variance,
        )
        residual = columns.data - self._current_matrix @ np.linalg.lstsq(self._template.m2c, columns.m2c)[0]
        residual /= columns.sigma
        gain, timing_sigma = present.value[GAIN], value[GAIN] * self._weights.gain_sigma(response)
        gain_sigma = float(np.hypot(np.sqrt(present.covariance[GAIN, GAIN]), timing_sigma))
        sigma = np.sqrt(np.diag(np.linalg.inv(system.information())))
        estimate = RegistrationEstimate(
            Registration.from_array(present.value[1:6]),
            present.covariance[1:6, 1:6],
            Estimate(float(gain), gain_sigma),
            Estimate(1 + state.width, float(sigma[WIDTH])),
            True,
            (),
            float(np.mean(np.square(system.residual))),
            actuator_corrections=self._actuator_corrections,
            extras={
                one.unknown.name: one.to_estimate(sigma, _systematic_error(self._model))
                for one in problem.extra_parameter_values(state)
            },
        )
        unit = compute_fitted_matrix(self._model, self._start, estimate, self._template.m2c)
        gains = np.asarray((self._current_matrix * unit).sum(axis=0) / np.square(unit).sum(axis=0))
        return LiveEstimate(
            estimate, present.random_covariance[1:6, 1:6], gains, self._gains_sigma(present, timing_sigma), present.rate[:6],
            float(np.abs(present.surprise).max()),
            float(np.mean(np.square(residual))), float(np.sqrt(block_sums.variance.mean())),
            state.actuator_gain.copy(), self._current_matrix, response,
        )  # fmt: skip

    def _extrapolate_to_now(
        self, problem: MixedEffectsProblem, system: NormalEquations, state: MixedEffectsState
    ) -> SmoothedState:
        """Gain, registration and curve now, without the memory's lag."""
        first_curve = _first_curve_index(problem)
        first_curve_index = SHAPE + 1 + first_curve
        selected = np.r_[0:6, first_curve_index : first_curve_index + len(self._command_curves)]
        total_covariance = sandwich_covariance(problem.weighted, system, self._sums.covariance)[
            np.ix_(selected, selected)
        ]
        noise = system.noise(problem.precision)[np.ix_(selected, selected)]
        total_covariance[np.arange(1, 6), np.arange(1, 6)] += np.square(_systematic_error(self._model))
        eigenvalues, directions = np.linalg.eigh(total_covariance - noise)
        static = (directions * np.maximum(eigenvalues, 0.0)) @ directions.T
        values = np.concatenate([[state.gain], state.alpha, state.variant[first_curve:]])
        return self._drift_line.update(values, noise, static)

    def _gains_sigma(self, present: SmoothedState, timing_sigma: float) -> NDArray[np.float64]:
        """Error of every mode's gain, by what the common gain and the curve err."""
        gain = present.value[GAIN]
        relative = 1 + present.value[6:] @ self._basis
        jacobian = np.concatenate([relative[None], np.zeros((5, relative.size)), gain * self._basis])
        covariance = present.random_covariance.copy()
        covariance[GAIN, GAIN] += timing_sigma**2
        variance = np.einsum("pm,pq,qm->m", jacobian, covariance, jacobian)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _first_curve_index(problem: MixedEffectsProblem) -> int:
    """Shares of variants and extra unknowns, which come before those of the gains' curve."""
    return problem.n_variants - len(problem.command_curves)


def _systematic_error(model: SyntheticModel) -> NDArray[np.float64]:
    """What a model itself is in doubt of, of the registration ``(5,)``."""
    return model.registration_systematic_error if isinstance(model, HasSystematicError) else np.zeros(5)


def scale_to_live_gains(matrix: InteractionMatrix, live: LiveEstimate) -> InteractionMatrix:
    """A pseudo-synthetic matrix at the live gain, with each mode's own gain in place of the common one."""
    ratio = live.gains / live.registration.gain.value
    return replace(matrix, data=(matrix.data * ratio).astype(np.float32), sigma=matrix.sigma * np.abs(ratio))
