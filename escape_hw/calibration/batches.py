"""SPRINT in batches of a few modes, as the paper runs it: one step of the registration per batch.

Every iteration solves the paper's Eq. (argmin_simple), a least-squares problem for ``g`` and ``g alpha``,
on the next few modes alone and moves by the learning rate times its answer; so no iteration simulates
the whole matrix. When all batches have had their turn, it starts again with the first.
"""

from __future__ import annotations

from collections.abc import Generator

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.model import SyntheticModel
from escape_hw.calibration.light import LARGEST, SMALL, LightFit, LightProblem
from escape_hw.calibration.weighted import WeightedMatrix

#: Modes of a batch (paper: about five).
BATCH = 5


class BatchProblem:
    """A weighted matrix that is looked at a few modes at a time.

    Parameters
    ----------
    weighted
        The measured matrix.
    model
        The synthetic model.
    learning_rate
        Share of each step that is taken (paper: gamma). At 1 every batch forgets what those before it
        found, and the answer is that of the last; the less, the more batches it averages over.
    """

    def __init__(self, weighted: WeightedMatrix, model: SyntheticModel, learning_rate: float) -> None:
        self._rate = learning_rate
        starts = range(0, weighted.data.shape[1], BATCH)
        self._batches = [LightProblem(weighted.columns(slice(k, k + BATCH)), model) for k in starts]
        self._whole = LightProblem(weighted, model)

    def descend(
        self, start: NDArray[np.float64], iterations: int
    ) -> Generator[LightFit, None, tuple[LightFit, NDArray[np.float64]]]:
        """Yield the fit of every batch before its step.

        Returns
        -------
        fit : LightFit
            On all modes, where the last batch led to; settled when a whole round led nowhere new.
        scatter : ndarray, ``(5, 5)``
            Covariance of the answer by the scatter of the batches' own answers in the last round: the
            stationary variance of a walk that moves by ``gamma`` times what is missing, ``gamma /
            (2 - gamma)`` of theirs.
        """
        alpha, settled = start, False
        answers = np.zeros((len(self._batches), 5))
        for _ in range(iterations):
            before = alpha
            for number, problem in enumerate(self._batches):
                fit = problem.linearise(alpha, np.zeros(5))
                full = problem.step(fit, 0.0)
                if full is None:
                    answers[number] = alpha
                    continue
                answers[number] = alpha + full
                step = self._rate * full / max(1.0, float(np.max(np.abs(full) / LARGEST)))
                fit.step = step
                yield fit
                alpha = alpha + step
            spread = np.sqrt(np.diag(self._scatter(answers)))
            if (np.abs(alpha - before) < np.maximum(SMALL, 0.02 * spread)).all():
                settled = True
                break
        last = self._whole.linearise(alpha, np.zeros(5))
        last.settled = settled
        return last, self._scatter(answers)

    def _scatter(self, answers: NDArray[np.float64]) -> NDArray[np.float64]:
        if len(answers) < 2:
            return np.zeros((5, 5))
        return np.asarray(np.cov(answers.T) * self._rate / (2 - self._rate))
