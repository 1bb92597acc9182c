"""The temporal response from pokes in closed loop, followed for as long as the loop runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.response import SLOPES, Filtered

#: Standard errors by which a known response may miss what is measured, and what is nothing in any case.
_APART, _LITTLE = 6.0, 0.05


class ResponseSums:
    """Weights of the lags by instrumental variables: what a matrix makes of the pokes at every lag.

    Slopes are regressed on what the matrix makes of the commands, with what it makes of the pokes as
    instruments, because the controller's part of a command answers to the turbulence
    (:mod:`~.fading_sums`).

    Parameters
    ----------
    lags
        Number of lags.
    """

    def __init__(self, lags: int) -> None:
        self._normal, self._right = np.zeros((lags, lags)), np.zeros(lags)
        self._scores, self._auto = np.zeros((lags, lags)), np.zeros((lags, lags))

    def add(self, block: Filtered, matrix: NDArray[np.float64]) -> None:
        """Take a block of filtered slopes, commands and pokes with the rows of the lags before it.

        Parameters
        ----------
        block
            Of a closed loop.
        matrix
            The best matrix known ``(n_slopes, n_modes)``.
        """
        step = max(1, -(-block.n_slopes // SLOPES))
        few = matrix[::step].T.astype(np.float32)
        lags, n, n_modes = len(self._right), block.n_slopes, block.n_modes
        rows = [block.before(lag)[:, n:] for lag in range(lags)]
        made = np.stack([row[:, :n_modes] @ few for row in rows])
        poked = np.stack([row[:, n_modes:] @ few for row in rows])
        slopes = block.slopes[:, ::step]
        slopes = slopes - slopes.mean(axis=0)
        # Loud slopes tell little.
        quiet = 1 / np.maximum(slopes.var(axis=0), 1e-12 * float(slopes.var()) + 1e-30)
        instruments = (poked - poked.mean(axis=1, keepdims=True)) * quiet
        flat = instruments.reshape(lags, -1).astype(np.float64)
        self._normal += flat @ made.reshape(lags, -1).T
        self._right += flat @ slopes.ravel()
        self._auto += flat @ poked.reshape(lags, -1).T
        left = slopes - np.tensordot(self._solved().astype(np.float32), made, axes=1)
        scores = np.einsum("lts,ts->lt", instruments, left).astype(np.float64)
        self._scores += scores @ scores.T

    def _solved(self) -> NDArray[np.float64]:
        return np.asarray(np.linalg.lstsq(self._normal, self._right, rcond=1e-9)[0])

    def response(self, known: TemporalResponse | None) -> TemporalResponse:
        """The response scaled to sum 1; the known one while it has the smaller errors and may be true.

        Parameters
        ----------
        known
            ``None``: none is.
        """
        if not self._right.any():
            if known is None:
                raise RuntimeError("no frames yet, and no response is known")
            return known
        weights = self._solved()
        total = float(weights.sum())
        bread = np.linalg.pinv(self._normal)
        # Scaled to sum 1, a weight errs with all others: d(w / sum) = (1 - w 1^T) dw / sum.
        scaled = (np.eye(weights.size) - np.outer(weights / total, np.ones(weights.size))) @ bread / total
        sigma = np.sqrt(np.diag(scaled @ self._scores @ scaled.T))
        measured = TemporalResponse(weights / total, sigma)
        if known is not None and known.sigma.max() < sigma.max() and not contradicts(measured, known):
            return known
        return measured

    def gain_sigma(self, response: TemporalResponse) -> float:
        """Relative error that the response's errors put on the gain of a matrix."""
        if not self._right.any():
            return 0.0
        seen = self._auto @ response.weights
        here = float(response.weights @ seen)
        # The weights' errors sum to zero, so what all lags have in common does not count.
        spread = float(np.sqrt(np.square((seen - here) * response.sigma).sum()))
        return spread / max(abs(here), 1e-300)


def contradicts(measured: TemporalResponse, known: TemporalResponse) -> bool:
    """Whether two responses differ by more than their errors let one expect."""
    errors = np.hypot(measured.sigma, known.sigma)
    apart = np.abs(measured.weights - known.weights)
    return bool((apart > np.maximum(_APART * errors, _LITTLE)).any())
