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

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import DoubtfulModel, SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.api.results import Measured, RegistrationEstimate, TemporalResponse
from escape_hw.calibration.covariance import sandwich
from escape_hw.calibration.extra_unknowns import as_told, unknowns_told
from escape_hw.calibration.fading_sums import FadingSums, turned
from escape_hw.calibration.found_mirror import found_matrix
from escape_hw.calibration.gain_curve import bends_of, curve_basis
from escape_hw.calibration.linearisation import GAIN, SHAPE, WIDTH, Problem, State
from escape_hw.calibration.live_response import ResponseSums
from escape_hw.calibration.misfit import NormalEquations, Priors
from escape_hw.calibration.response import Filtered, filtered
from escape_hw.calibration.robust import as_trusted
from escape_hw.calibration.straight_line import Present, StraightLine
from escape_hw.calibration.telemetry import Telemetry
from escape_hw.calibration.telemetry_sprint import fitted_whitener
from escape_hw.calibration.weighted import WeightedMatrix
from escape_hw.errors import TooFewFrames

#: Drift per second that is nothing unusual: relative gain, registration, coefficients of the gains' curve.
_FASTEST = np.array([0.05, 0.5, 0.5, 0.02, 0.1, 0.1])
_FASTEST_BEND = 0.1
#: Gauss-Newton steps of the first update, and largest step in standard deviations of what is usual.
_FIRST_STEPS, _LARGEST = 5, np.array([60.0, 60.0, 2.0, 4.0, 4.0])
#: Least error of a width that is taken over.
_WIDTH_SIGMA = 0.005
#: Updates after which the whitening filter is found anew, again and again.
_WHITEN_EVERY = 15
#: Whitened frames without which no update is made.
_LEAST_FRAMES = 50


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
    actuators: NDArray[np.float64]
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
        frame: InteractionMatrix,
        model: SyntheticModel,
        start: RegistrationEstimate,
        *,
        order: int,
        lags: int,
        memory: float = 10.0,
        step_s: float = 1.0,
        curved: int = 0,
        response: TemporalResponse | None = None,
    ) -> None:
        self._frame, self._model, self._start = frame, model, start.registration
        scatter = min(Priors().width, max(start.width.sigma, _WIDTH_SIGMA))
        self._extras = unknowns_told(model, start.extras)
        self._priors = Priors(
            width=scatter, mean_width=start.width.value - 1, extras=as_told(self._extras, start.extras)
        )
        # Small pokes tell little of single actuators: what the calibration found of them stays.
        self._mirror = start.departures
        self._order, self._lags, self._response = order, lags, response
        self._basis = curve_basis(frame.n_modes, curved)
        self._bends = bends_of(frame.m2c, self._basis)
        self._keep = float(np.exp(-1 / memory))
        fastest = np.concatenate([_FASTEST, np.full(curved, _FASTEST_BEND)])
        self._line = StraightLine(self._keep if self._keep < 1 else 1 - 1e-9, step_s, fastest)
        # At the mean age of the sums, and now.
        self._matrix = self._now = frame.data.astype(np.float64)
        self.restart()

    def restart(self) -> None:
        """Forget all frames; the last estimate is where the next one starts from."""
        self._sums = FadingSums.zeros(*self._frame.data.shape)
        self._weights = ResponseSums(self._lags)
        self._whitener: NDArray[np.float64] | None = None
        self._state: State | None = None
        self._updates = 0
        self._line.restart()

    @property
    def memory_rows(self) -> int:
        """Rows before a block's first new one that its filtered rows are made of."""
        return 2 * self._order + self._lags

    def update(self, data: Telemetry, start: int = 0) -> LiveEstimate:
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
        self._weights.add(block, self._now)
        response = self._weights.response(self._response)
        seen = block.driven(response.weights)
        if self._state is None:
            # The residual by the matrix in use is not the noise yet: fit once for a better one.
            self._take(block, seen)
            self._state = self._step()[2]
            self._now, self._sums = self._matrix, FadingSums.zeros(*self._frame.data.shape)
        own = self._take(block, seen)
        problem, system, self._state = self._step()
        self._updates += 1
        return self._estimate(problem, system, self._state, own, response)

    def _take(self, block: Filtered, seen: NDArray[np.float32]) -> FadingSums:
        """Let the sums fade and add a block; the block's own sums."""
        n_modes = self._frame.n_modes
        own = FadingSums.zeros(*self._frame.data.shape)
        own.add(block.slopes, seen[:, :n_modes], seen[:, n_modes:], self._now.astype(np.float32))
        self._sums.forget(self._keep)
        self._sums.merge(own)
        return own

    def _whiten(self, data: Telemetry, start: int) -> None:
        """Find the filter, and the first time the response as well, on a block."""
        first = self._whitener is None
        if first:
            self._whitener = np.array([1.0, -1.0]) if self._order else np.ones(1)
        n_modes = self._frame.n_modes
        if first and self._response is None:
            sums = ResponseSums(self._lags)
            sums.add(self._filtered(data, start), self._now)
            self._response = sums.response(None)
        if self._order:
            response = self._weights.response(self._response)
            commands = Telemetry(data.rows[:, :-n_modes], data.present, data.n_slopes)
            self._whitener = fitted_whitener(commands, self._now, response, self._order, self._lags)

    def _filtered(self, data: Telemetry, start: int) -> Filtered:
        if self._whitener is None:
            raise RuntimeError("the filter comes first")
        block = filtered(data, self._whitener, self._lags, start)
        if len(block.now) < _LEAST_FRAMES:
            raise TooFewFrames(
                f"{len(block.now)} frames whose past is known are too few for an update; "
                f"at least {_LEAST_FRAMES} are needed"
            )
        return block

    def _step(self) -> tuple[Problem, NormalEquations, State]:
        """Gauss-Newton on the sums: one step, or several the first time."""
        state = self._state
        for _ in range(_FIRST_STEPS if state is None else 1):
            columns = self._sums.columns(self._frame, self._matrix)
            weighted = as_trusted(WeightedMatrix.of(columns, np.arange(columns.n_modes)), self._model)
            problem = Problem(weighted, self._model, self._priors, self._bends, self._extras)
            state = state or problem.start(self._start)
            system = problem.linearise(state)
            step = system.solve()
            longest = float(np.max(np.abs(step[1:6]) / _LARGEST))
            state = problem.move(state, step / max(longest, 1.0))
            self._matrix = problem.matrix(state, self._frame.m2c)
        if state is None:
            raise RuntimeError("no step was made")
        return problem, system, state

    def _estimate(
        self,
        problem: Problem,
        system: NormalEquations,
        state: State,
        own: FadingSums,
        response: TemporalResponse,
    ) -> LiveEstimate:
        present = self._present(problem, system, state)
        value = present.value
        here = np.concatenate([state.variant[: _unbent(problem)], value[6:]])
        there = replace(state, gain=float(value[GAIN]), alpha=value[1:6], variant=here)
        self._now = problem.matrix(there, self._frame.m2c)
        self._start = Registration.from_array(value[1:6])
        columns = turned(self._frame, own.cross, own.mixed, own.gram, self._sums.variance)
        left = columns.data - self._now @ np.linalg.lstsq(self._frame.m2c, columns.m2c)[0]
        left /= columns.sigma
        gain, timing = present.value[GAIN], value[GAIN] * self._weights.gain_sigma(response)
        gain_sigma = float(np.hypot(np.sqrt(present.covariance[GAIN, GAIN]), timing))
        sigma = np.sqrt(np.diag(np.linalg.inv(system.information())))
        estimate = RegistrationEstimate(
            Registration.from_array(present.value[1:6]),
            present.covariance[1:6, 1:6],
            Measured(float(gain), gain_sigma),
            Measured(1 + state.width, float(sigma[WIDTH])),
            True,
            (),
            float(np.mean(np.square(system.residual))),
            departures=self._mirror,
            extras={
                one.unknown.name: one.measured(sigma, _doubt(self._model))
                for one in problem.extras_found(state)
            },
        )
        unit = found_matrix(self._model, self._start, estimate, self._frame.m2c)
        gains = np.asarray((self._now * unit).sum(axis=0) / np.square(unit).sum(axis=0))
        return LiveEstimate(
            estimate, present.moving[1:6, 1:6], gains, self._gains_sigma(present, timing), present.rate[:6],
            float(np.abs(present.surprise).max()),
            float(np.mean(np.square(left))), float(np.sqrt(own.variance.mean())),
            state.actuator_gain.copy(), self._now, response,
        )  # fmt: skip

    def _present(self, problem: Problem, system: NormalEquations, state: State) -> Present:
        """Gain, registration and curve now, without the memory's lag."""
        unbent = _unbent(problem)
        after = SHAPE + 1 + unbent
        picked = np.r_[0:6, after : after + len(self._bends)]
        whole = sandwich(problem.weighted, system, self._sums.covariance)[np.ix_(picked, picked)]
        noise = system.noise(problem.precision)[np.ix_(picked, picked)]
        whole[np.arange(1, 6), np.arange(1, 6)] += np.square(_doubt(self._model))
        shares, directions = np.linalg.eigh(whole - noise)
        static = (directions * np.maximum(shares, 0.0)) @ directions.T
        values = np.concatenate([[state.gain], state.alpha, state.variant[unbent:]])
        return self._line.update(values, noise, static)

    def _gains_sigma(self, present: Present, timing: float) -> NDArray[np.float64]:
        """Error of every mode's gain, by what the common gain and the curve err."""
        gain = present.value[GAIN]
        relative = 1 + present.value[6:] @ self._basis
        jacobian = np.concatenate([relative[None], np.zeros((5, relative.size)), gain * self._basis])
        covariance = present.moving.copy()
        covariance[GAIN, GAIN] += timing**2
        variance = np.einsum("pm,pq,qm->m", jacobian, covariance, jacobian)
        return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _unbent(problem: Problem) -> int:
    """Shares of variants and extra unknowns, which come before those of the gains' curve."""
    return problem.n_variants - len(problem.bends)


def _doubt(model: SyntheticModel) -> NDArray[np.float64]:
    """What a model itself is in doubt of, of the registration ``(5,)``."""
    return model.registration_doubt if isinstance(model, DoubtfulModel) else np.zeros(5)


def scaled_to_gains(matrix: InteractionMatrix, live: LiveEstimate) -> InteractionMatrix:
    """A pseudo-synthetic matrix at the live gain, with each mode's own gain in place of the common one."""
    share = live.gains / live.registration.gain.value
    return replace(matrix, data=(matrix.data * share).astype(np.float32), sigma=matrix.sigma * np.abs(share))
