"""How much of random effects to believe, by the likelihood of their scatter."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

#: Rounds of the fixed point; later ones change the scatter by less than a percent.
_ROUNDS = 20
#: Effects of exactly zero that are taken to have been seen beside: a scatter that a handful of effects
#: suggests may be chance, and what is left out then costs less than what is made up.
_ZEROS = 2.0


def believed(
    information: NDArray[np.float64],
    value: NDArray[np.float64],
    precision: NDArray[np.float64],
    kinds: Sequence[slice],
    bounds: Sequence[tuple[float, float]],
    noise: float = 1.0,
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Effects with the priors that make the data likeliest, from a solution with other priors.

    The scatter of each kind of effects goes to ``sum x^2 / sum(1 - var / scatter^2)`` (MacKay 1992, eq.
    4.9 and 4.10), the fixed point of the evidence, with a few effects of zero added to the count. Unlike a
    prior that was chosen, it goes to nothing where the data say nothing, and then so do the effects.

    Parameters
    ----------
    information
        Normal matrix of the unknowns with their present priors in it ``(n, n)``.
    value
        The solution, from the priors' means ``(n,)``.
    precision
        Present priors ``(n,)``.
    kinds
        Which unknowns share a scatter.
    bounds
        Least and largest scatter of each kind.
    noise
        Noise of the data in the units of ``information``.

    Returns
    -------
    value, sigma : ndarray, ``(n,)``
        Posterior mean, and standard error.
    """
    data = (information - np.diag(precision)) / noise**2
    # At the solution data and priors are in balance.
    pull = information @ value / noise**2
    prior = precision.copy()
    for _ in range(_ROUNDS):
        covariance = np.linalg.inv(data + np.diag(prior))
        found = covariance @ pull
        for kind, (least, largest) in zip(kinds, bounds, strict=True):
            told = np.sum(1 - np.diag(covariance)[kind] * prior[kind])
            square = np.square(found[kind]).sum() / (float(told) + _ZEROS)
            prior[kind] = 1 / np.clip(square, least**2, largest**2)
    return found, np.sqrt(np.maximum(np.diag(covariance), 0.0))
