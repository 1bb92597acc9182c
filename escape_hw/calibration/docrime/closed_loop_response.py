"""The temporal response from pokes in closed loop, followed for as long as the loop runs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import TemporalResponse
from escape_hw.calibration.docrime.response import RESPONSE_SLOPES, FilteredTelemetry, LagSums, stack_lags

#: Standard errors by which a known response may miss what is measured, and what is nothing in any case.
_MAX_DIFFERENCE_SIGMA, _NEGLIGIBLE_DIFFERENCE = 6.0, 0.05


class ResponseAccumulator:
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
        self._sums, self._lags = LagSums(lags), lags
        self._auto = np.zeros((lags, lags))

    def add(self, block: FilteredTelemetry, matrix: NDArray[np.float64]) -> None:
        """Take a block of filtered slopes, commands and pokes with the rows of the lags before it.

        Parameters
        ----------
        block
            Of a closed loop.
        matrix
            The best matrix known ``(n_slopes, n_modes)``.
        """
        stride = max(1, -(-block.n_slopes // RESPONSE_SLOPES))
        sampled_matrix = matrix[::stride].T.astype(np.float32)
        n_modes = block.n_modes
        rows = block.rows[:, block.n_slopes :]
        command_slopes = stack_lags(rows[:, :n_modes] @ sampled_matrix, block.now, self._lags)
        poke_slopes = stack_lags(rows[:, n_modes:] @ sampled_matrix, block.now, self._lags)
        slopes = block.slopes[:, ::stride]
        slopes = slopes - slopes.mean(axis=0)
        # Loud slopes tell little.
        inverse_variance = 1 / np.maximum(slopes.var(axis=0), 1e-12 * float(slopes.var()) + 1e-30)
        instruments = (poke_slopes - poke_slopes.mean(axis=0)) * inverse_variance
        self._sums.add(slopes, command_slopes - command_slopes.mean(axis=0), instruments)
        self._auto += np.einsum("tls,tks->lk", instruments, poke_slopes, optimize=True)

    def response(self, known: TemporalResponse | None) -> TemporalResponse:
        """The response scaled to sum 1; the known one while it has the smaller errors and may be true.

        Parameters
        ----------
        known
            ``None``: none is.
        """
        if not self._auto.any():
            if known is None:
                raise RuntimeError("no frames yet, and no response is known")
            return known
        measured = self._sums.response().response
        better = known is not None and known.sigma.max() < measured.sigma.max()
        if known is not None and better and not responses_differ(measured, known):
            return known
        return measured

    def gain_sigma(self, response: TemporalResponse) -> float:
        """Relative error that the response's errors put on the gain of a matrix."""
        if not self._auto.any():
            return 0.0
        weighted_auto = self._auto @ response.weights
        power = float(response.weights @ weighted_auto)
        # The weights' errors sum to zero, so what all lags have in common does not count.
        spread = float(np.sqrt(np.square((weighted_auto - power) * response.sigma).sum()))
        return spread / max(abs(power), 1e-300)


def responses_differ(measured: TemporalResponse, known: TemporalResponse) -> bool:
    """Whether two responses differ by more than their errors let one expect."""
    errors = np.hypot(measured.sigma, known.sigma)
    difference = np.abs(measured.weights - known.weights)
    return bool((difference > np.maximum(_MAX_DIFFERENCE_SIGMA * errors, _NEGLIGIBLE_DIFFERENCE)).any())
