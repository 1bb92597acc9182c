"""SPRINT with a gain for every mode, as it was first published (Heritier et al. 2021).

Solves the paper's Eq. (argmin_full), ``min over G, alpha of |D - G (D_0 + alpha Lambda)|`` with a diagonal
``G``, by turns: the gains for a given registration, then the registration for these gains.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.calibration.derivatives import modal_jacobian
from escape_hw.calibration.light import LARGEST, SMALL, LightFit
from escape_hw.calibration.weighted import WeightedMatrix


class DiagonalProblem:
    """A weighted matrix whose modes have gains of their own.

    Parameters
    ----------
    weighted
        The measured matrix.
    model
        The synthetic model.
    learning_rate
        Share of each step of the registration that is taken.
    """

    def __init__(self, weighted: WeightedMatrix, model: SyntheticModel, learning_rate: float) -> None:
        self.weighted, self._model, self._rate = weighted, model, learning_rate
        self._modes = weighted.modes

    def descend(self, start: NDArray[np.float64], iterations: int) -> Generator[LightFit, None, LightFit]:
        """Yield every state from a start on; return the last.

        Its gain is the mean gain, and its derivatives are those that no mode's gain can imitate, so
        that information and errors count the gains as unknown.
        """
        alpha, step = start, np.zeros(5)
        for _ in range(iterations + 1):
            here = Registration.from_array(alpha)
            parts = modal_jacobian(self._model, here, self._modes)
            unit, derivatives = (self.weighted.weigh(part) for part in parts)
            power = np.maximum(np.square(unit).sum(axis=0), 1e-300)
            gains = (unit * self.weighted.data).sum(axis=0) / power
            moved = gains * derivatives[:5]
            residual = self.weighted.data - gains * unit
            fit = _fit(alpha, gains, unit, moved, power, residual, step)
            wanted = _least_squares(moved, residual)
            if wanted is None:
                return fit
            spread = np.sqrt(np.abs(np.diag(np.linalg.pinv(fit.information()))))[1:]
            spread *= self.weighted.noise(residual)
            fit.settled = bool((np.abs(wanted) < np.maximum(SMALL, 0.02 * spread)).all())
            yield fit
            if fit.settled:
                break
            step = self._rate * wanted / max(1.0, float(np.max(np.abs(wanted) / LARGEST)))
            alpha = alpha + step
        return fit


def _least_squares(
    derivatives: NDArray[np.float64], residual: NDArray[np.float64]
) -> NDArray[np.float64] | None:
    """The step that these derivatives ``(5, ...)`` ask for; ``None`` where they tell nothing."""
    flat = derivatives.reshape(5, -1)
    try:
        step = np.linalg.solve(flat @ flat.T, flat @ residual.ravel())
    except np.linalg.LinAlgError:
        return None
    return np.asarray(step) if np.isfinite(step).all() else None


def _fit(
    alpha: NDArray[np.float64],
    gains: NDArray[np.float64],
    unit: NDArray[np.float64],
    moved: NDArray[np.float64],
    power: NDArray[np.float64],
    residual: NDArray[np.float64],
    step: NDArray[np.float64],
) -> LightFit:
    """As a fit with one gain, the mean of all by what they explain."""
    mean = float(np.average(gains, weights=power))
    own = moved - unit * ((moved * unit).sum(axis=1) / power)[:, None]
    scale = mean if mean else 1.0
    return LightFit(alpha, mean, unit, own / scale, residual, step)
