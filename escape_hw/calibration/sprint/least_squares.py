"""Registration-only least-squares solvers of SPRINT.

Damped Gauss-Newton for one gain and five parameters (paper, Eq. argmin_simple), the same in batches of a few
modes, and with one gain per mode (Eq. argmin_full).
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.modes.derivatives import modal_jacobian, modal_matrix
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Largest step of an iteration, in the units of the parameters: the model is only locally linear.
MAX_STEP = np.array([120.0, 120.0, 4.0, 8.0, 8.0])
#: A step below this, or below a fiftieth of the standard errors, ends the descent.
NEGLIGIBLE_STEP = np.array([5e-3, 5e-3, 2e-4, 2e-3, 2e-3])
#: The derivatives are kept after a step below this fraction of the largest one.
_REUSE_JACOBIAN_BELOW = 0.1
#: Levenberg damping after a step that increased the cost, and the damping at which the descent gives up.
_FIRST_DAMPING, _MAX_DAMPING = 1e-2, 1e4


@dataclass(slots=True, eq=False)
class LeastSquaresFit:
    """Gain and registration at one iteration.

    Parameters
    ----------
    alpha, gain
        The registration ``(5,)``, and the best gain there.
    model_matrix
        The model's matrix at gain 1 ``(n_slopes, n_modes)``, in standard errors.
    derivatives
        Its derivatives by the registration ``(5, n_slopes, n_modes)``, here or at a nearby registration.
    residual
        Data minus model ``(n_slopes, n_modes)``, in standard errors.
    step
        The last step ``(5,)``; zero at the start.
    steps_converged
        Whether the next step would be negligible.
    """

    alpha: NDArray[np.float64]
    gain: float
    model_matrix: NDArray[np.float64]
    derivatives: NDArray[np.float64]
    residual: NDArray[np.float64]
    step: NDArray[np.float64]
    steps_converged: bool = False

    @property
    def cost(self) -> float:
        """Sum of the squared residual."""
        return float(np.square(self.residual).sum())

    def information(self) -> NDArray[np.float64]:
        """Information on gain and registration ``(6, 6)``."""
        flat = self.projected_jacobian().reshape(6, -1)
        return np.asarray(flat @ flat.T)

    def projected_jacobian(self) -> NDArray[np.float64]:
        """Derivatives by gain and registration ``(6, n_slopes, n_modes)``."""
        return np.concatenate([self.model_matrix[None], self.gain * self.derivatives])


class LeastSquaresProblem:
    """Fit of gain and registration to a weighted matrix.

    The learning rate (paper: gamma) is the fraction of each step that is taken, in (0, 1]. With ``frozen``
    the derivatives of the start are kept, as in the first publications: an iteration then computes a matrix
    without its derivatives, but more iterations are needed.
    """

    def __init__(
        self,
        weighted: WeightedMatrix,
        model: SyntheticModel,
        learning_rate: float = 1.0,
        frozen: bool = False,
    ) -> None:
        self.weighted, self._model, self._learning_rate = weighted, model, learning_rate
        self._relinearise_above = np.inf if frozen else _REUSE_JACOBIAN_BELOW
        self._modes = weighted.modes

    def matrix(self, alpha: NDArray[np.float64]) -> NDArray[np.float64]:
        """The model's matrix at gain 1, in standard errors."""
        registration = Registration.from_array(alpha)
        return self.weighted.weigh(modal_matrix(self._model, registration, self._modes))

    def linearise(self, alpha: NDArray[np.float64], step: NDArray[np.float64]) -> LeastSquaresFit:
        """Model, derivatives and gain about a registration."""
        parts = modal_jacobian(self._model, Registration.from_array(alpha), self._modes)
        model_matrix, derivatives = (self.weighted.weigh(part) for part in parts)
        return self._fit(alpha, model_matrix, derivatives[:5], step)

    def explained_fraction(self, alpha: NDArray[np.float64]) -> float:
        """Fraction of the sum of squares that the model explains at its best gain."""
        model_matrix = self.matrix(alpha)
        return self.weighted.explained_fraction(
            self.weighted.data - self._best_gain(model_matrix) * model_matrix
        )

    def descend(
        self, start: NDArray[np.float64], iterations: int
    ) -> Generator[LeastSquaresFit, None, LeastSquaresFit]:
        """Yield every accepted step from a start, the start included; return the last."""
        fit, damping = self.linearise(start, np.zeros(5)), 0.0
        yield fit
        for _ in range(iterations):
            step = self.step(fit, damping)
            if step is None or (fit.steps_converged and damping == 0):
                break
            longest = float(np.max(np.abs(step) / MAX_STEP))
            step = step * self._learning_rate / max(longest, 1.0)
            trial = self._fit(fit.alpha + step, self.matrix(fit.alpha + step), fit.derivatives, step)
            if trial.cost < fit.cost:
                damping = damping / 10 if damping > 1e-6 else 0.0
                fit = trial if longest < self._relinearise_above else self.linearise(trial.alpha, step)
                yield fit
                continue
            damping = max(10 * damping, _FIRST_DAMPING)
            if fit.steps_converged or damping > _MAX_DAMPING:
                break
        return fit

    def step(self, fit: LeastSquaresFit, damping: float) -> NDArray[np.float64] | None:
        """Damped Gauss-Newton step, ``None`` if singular; sets ``fit.steps_converged``."""
        information = fit.information()
        right = fit.projected_jacobian().reshape(6, -1) @ fit.residual.ravel()
        try:
            step = np.linalg.solve(information + damping * np.diag(np.diag(information)), right)[1:]
            spread = np.sqrt(np.abs(np.diag(np.linalg.inv(information))))[1:]
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        spread *= self.weighted.noise_level(fit.residual)
        fit.steps_converged = _is_negligible(step, spread)
        return np.asarray(step)

    def _best_gain(self, model_matrix: NDArray[np.float64]) -> float:
        return float(
            np.vdot(model_matrix, self.weighted.data)
            / max(float(np.vdot(model_matrix, model_matrix)), 1e-300)
        )

    def _fit(
        self,
        alpha: NDArray[np.float64],
        model_matrix: NDArray[np.float64],
        derivatives: NDArray[np.float64],
        step: NDArray[np.float64],
    ) -> LeastSquaresFit:
        gain = self._best_gain(model_matrix)
        return LeastSquaresFit(
            alpha, gain, model_matrix, derivatives, self.weighted.data - gain * model_matrix, step
        )


#: Modes of a batch (paper: about five).
BATCH_SIZE = 5


class BatchProblem:
    """Fit of gain and registration to batches of a few modes, one after the other.

    At a learning rate of 1 the result is that of the last batch alone; the smaller the rate, the more batches
    it averages over.
    """

    def __init__(self, weighted: WeightedMatrix, model: SyntheticModel, learning_rate: float) -> None:
        self._learning_rate = learning_rate
        starts = range(0, weighted.data.shape[1], BATCH_SIZE)
        self._batches = [
            LeastSquaresProblem(weighted.columns(slice(k, k + BATCH_SIZE)), model) for k in starts
        ]
        self._all_modes = LeastSquaresProblem(weighted, model)

    def descend(
        self, start: NDArray[np.float64], iterations: int
    ) -> Generator[LeastSquaresFit, None, tuple[LeastSquaresFit, NDArray[np.float64]]]:
        """Yield the fit of every batch before its step.

        Returns
        -------
        fit : LeastSquaresFit
            Of all modes, at the registration after the last batch; converged if the last pass through all
            batches changed it negligibly.
        covariance : ndarray, ``(5, 5)``
            Covariance of the registration from the scatter of the batches' own solutions in the last pass:
            a walk by ``gamma`` times the distance to each solution has the stationary variance ``gamma /
            (2 - gamma)`` of theirs.
        """
        alpha, steps_converged = start, False
        batch_solutions = np.zeros((len(self._batches), 5))
        for _ in range(iterations):
            round_start = alpha
            for number, problem in enumerate(self._batches):
                fit = problem.linearise(alpha, np.zeros(5))
                full_step = problem.step(fit, 0.0)
                if full_step is None:
                    batch_solutions[number] = alpha
                    continue
                batch_solutions[number] = alpha + full_step
                step = _limit_step(full_step, self._learning_rate)
                fit.step = step
                yield fit
                alpha = alpha + step
            spread = np.sqrt(np.diag(self._batch_covariance(batch_solutions)))
            steps_converged = _is_negligible(alpha - round_start, spread)
            if steps_converged:
                break
        last = self._all_modes.linearise(alpha, np.zeros(5))
        last.steps_converged = steps_converged
        return last, self._batch_covariance(batch_solutions)

    def _batch_covariance(self, batch_solutions: NDArray[np.float64]) -> NDArray[np.float64]:
        if len(batch_solutions) < 2:
            return np.zeros((5, 5))
        return np.asarray(np.cov(batch_solutions.T) * self._learning_rate / (2 - self._learning_rate))


class DiagonalProblem:
    """Fit of the registration and one gain per mode, in alternation."""

    def __init__(self, weighted: WeightedMatrix, model: SyntheticModel, learning_rate: float) -> None:
        self.weighted, self._model, self._learning_rate = weighted, model, learning_rate
        self._modes = weighted.modes

    def descend(
        self, start: NDArray[np.float64], iterations: int
    ) -> Generator[LeastSquaresFit, None, LeastSquaresFit]:
        """Yield the fit of every iteration; return the last.

        Its gain is the mean of the gains, and its derivatives are orthogonal to them, so that the
        information counts the gains as unknown.
        """
        alpha, step = start, np.zeros(5)
        for _ in range(iterations + 1):
            registration = Registration.from_array(alpha)
            parts = modal_jacobian(self._model, registration, self._modes)
            model_matrix, derivatives = (self.weighted.weigh(part) for part in parts)
            power = np.maximum(np.square(model_matrix).sum(axis=0), 1e-300)
            gains = (model_matrix * self.weighted.data).sum(axis=0) / power
            registration_jacobian = gains * derivatives[:5]
            residual = self.weighted.data - gains * model_matrix
            mean = float(np.average(gains, weights=power))
            overlap = (registration_jacobian * model_matrix).sum(axis=1) / power
            projected = registration_jacobian - model_matrix * overlap[:, None]
            fit = LeastSquaresFit(alpha, mean, model_matrix, projected / (mean or 1.0), residual, step)
            full_step = _solve_step(registration_jacobian, residual)
            if full_step is None:
                return fit
            spread = np.sqrt(np.abs(np.diag(np.linalg.pinv(fit.information()))))[1:]
            spread *= self.weighted.noise_level(residual)
            fit.steps_converged = _is_negligible(full_step, spread)
            yield fit
            if fit.steps_converged:
                break
            step = _limit_step(full_step, self._learning_rate)
            alpha = alpha + step
        return fit


def _is_negligible(step: NDArray[np.floating], sigma: NDArray[np.float64]) -> bool:
    return bool((np.abs(step) < np.maximum(NEGLIGIBLE_STEP, 0.02 * sigma)).all())


def _limit_step(step: NDArray[np.float64], learning_rate: float) -> NDArray[np.float64]:
    """The fraction of a step that is taken, no longer than :data:`MAX_STEP`."""
    return learning_rate * step / max(1.0, float(np.max(np.abs(step) / MAX_STEP)))


def _solve_step(
    derivatives: NDArray[np.float64], residual: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """Gauss-Newton step for derivatives ``(5, ...)``; ``None`` if they are singular."""
    flat = derivatives.reshape(5, -1)
    try:
        step = np.linalg.solve(flat @ flat.T, flat @ residual.ravel())
    except np.linalg.LinAlgError:
        return None
    return np.asarray(step) if np.isfinite(step).all() else None
