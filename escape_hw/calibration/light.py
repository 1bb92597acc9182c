"""SPRINT as the paper writes it: gain and registration only, by damped Gauss-Newton.

``min over g, alpha of |D - g U(alpha)|`` (paper Eq. argmin_simple). For a given registration the
best gain is known, so the descent runs over five parameters. It is many times faster than the
solver with random effects (:mod:`~.linearisation`), finds home from farther away, and is as accurate
on a mirror that is like its model.
"""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.calibration.derivatives import modal_jacobian, modal_matrix
from escape_hw.calibration.weighted import WeightedMatrix

#: Largest move in one iteration, in the units of the parameters: the model is only locally linear.
LARGEST = np.array([120.0, 120.0, 4.0, 8.0, 8.0])
#: A step below this, or below a fiftieth of the standard error, ends the descent.
SMALL = np.array([5e-3, 5e-3, 2e-4, 2e-3, 2e-3])
#: A step below this share of the largest leaves the derivatives as they were.
_FROZEN = 0.1
#: Levenberg's damping after a step that made things worse, and where to give up.
_DAMPED, _STUCK = 1e-2, 1e4


@dataclass(slots=True, eq=False)
class LightFit:
    """Gain and registration at some point of the descent.

    Parameters
    ----------
    alpha
        The registration ``(5,)``.
    gain
        The gain that fits best there.
    unit
        The model's matrix at gain 1 ``(n_slopes, n_modes)``, in standard errors.
    derivatives
        Its derivatives by the registration ``(5, n_slopes, n_modes)``, at this place or near it.
    residual
        What is left ``(n_slopes, n_modes)``, in standard errors.
    step
        The last step ``(5,)``; zero at the start.
    settled
        Whether the next step would be too small to matter.
    """

    alpha: NDArray[np.float64]
    gain: float
    unit: NDArray[np.float64]
    derivatives: NDArray[np.float64]
    residual: NDArray[np.float64]
    step: NDArray[np.float64]
    settled: bool = False

    @property
    def cost(self) -> float:
        """Sum of the squared residual."""
        return float(np.square(self.residual).sum())

    def information(self) -> NDArray[np.float64]:
        """Information on gain and registration ``(6, 6)``."""
        flat = self.efficient().reshape(6, -1)
        return np.asarray(flat @ flat.T)

    def efficient(self) -> NDArray[np.float64]:
        """Derivatives by gain and registration ``(6, n_slopes, n_modes)``."""
        return np.concatenate([self.unit[None], self.gain * self.derivatives])


class LightProblem:
    """A weighted matrix and the model that is to explain it.

    Parameters
    ----------
    weighted
        The measured matrix.
    model
        The synthetic model.
    learning_rate
        Share of each step that is taken, in (0, 1] (paper: gamma).
    frozen
        Whether the derivatives stay those of the start, as in the first publications: an iteration then
        costs a matrix instead of a matrix and its derivatives, and there are more of them.
    """

    def __init__(
        self,
        weighted: WeightedMatrix,
        model: SyntheticModel,
        learning_rate: float = 1.0,
        frozen: bool = False,
    ) -> None:
        self.weighted, self._model, self._rate = weighted, model, learning_rate
        self._renewed = np.inf if frozen else _FROZEN
        self._modes = weighted.modes

    def matrix(self, alpha: NDArray[np.float64]) -> NDArray[np.float64]:
        """The model's matrix at gain 1, in standard errors."""
        here = Registration.from_array(alpha)
        return self.weighted.weigh(modal_matrix(self._model, here, self._modes))

    def linearise(self, alpha: NDArray[np.float64], step: NDArray[np.float64]) -> LightFit:
        """Model, derivatives and gain about a registration."""
        parts = modal_jacobian(self._model, Registration.from_array(alpha), self._modes)
        unit, derivatives = (self.weighted.weigh(part) for part in parts)
        return self._fit(alpha, unit, derivatives[:5], step)

    def explained(self, alpha: NDArray[np.float64]) -> float:
        """Share of the squared elements that the model explains at its best gain."""
        unit = self.matrix(alpha)
        return self.weighted.explained(self.weighted.data - self._gain(unit) * unit)

    def descend(self, start: NDArray[np.float64], iterations: int) -> Generator[LightFit, None, LightFit]:
        """Yield every accepted step from a start, the start included; return the last."""
        fit, damping = self.linearise(start, np.zeros(5)), 0.0
        yield fit
        for _ in range(iterations):
            step = self.step(fit, damping)
            if step is None or (fit.settled and damping == 0):
                break
            longest = float(np.max(np.abs(step) / LARGEST))
            step = step * self._rate / max(longest, 1.0)
            trial = self._fit(fit.alpha + step, self.matrix(fit.alpha + step), fit.derivatives, step)
            if trial.cost < fit.cost:
                damping = damping / 10 if damping > 1e-6 else 0.0
                fit = trial if longest < self._renewed else self.linearise(trial.alpha, step)
                yield fit
                continue
            damping = max(10 * damping, _DAMPED)
            if fit.settled or damping > _STUCK:
                break
        return fit

    def step(self, fit: LightFit, damping: float) -> NDArray[np.float64] | None:
        """Damped Gauss-Newton step of the registration; also tells the fit whether it has settled."""
        information = fit.information()
        right = fit.efficient().reshape(6, -1) @ fit.residual.ravel()
        try:
            step = np.linalg.solve(information + damping * np.diag(np.diag(information)), right)[1:]
            spread = np.sqrt(np.abs(np.diag(np.linalg.inv(information))))[1:]
        except np.linalg.LinAlgError:
            return None
        if not np.isfinite(step).all():
            return None
        spread *= self.weighted.noise(fit.residual)
        fit.settled = bool((np.abs(step) < np.maximum(SMALL, 0.02 * spread)).all())
        return np.asarray(step)

    def _gain(self, unit: NDArray[np.float64]) -> float:
        return float(np.vdot(unit, self.weighted.data) / max(float(np.vdot(unit, unit)), 1e-300))

    def _fit(
        self,
        alpha: NDArray[np.float64],
        unit: NDArray[np.float64],
        derivatives: NDArray[np.float64],
        step: NDArray[np.float64],
    ) -> LightFit:
        gain = self._gain(unit)
        return LightFit(alpha, gain, unit, derivatives, self.weighted.data - gain * unit, step)
