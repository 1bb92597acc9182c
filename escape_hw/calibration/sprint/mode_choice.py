"""Which modes SPRINT looks at: by their signal, by their order, or by what they tell of the registration."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.sprint.least_squares import MAX_STEP, LeastSquaresProblem
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
from escape_hw.config.choices import ModesChoice

#: Information that every parameter is given to begin with, relative to that of all modes together: the
#: first mode alone cannot tell all of them apart.
_PRIOR_INFORMATION = 1e-6


def choose_modes(
    matrix: InteractionMatrix,
    n_modes: int,
    modes_choice: ModesChoice = "snr",
    model: SyntheticModel | None = None,
    start: Registration | None = None,
) -> NDArray[np.intp]:
    """The ``n_modes`` modes to fit, in their own order.

    Parameters
    ----------
    matrix
        The measured matrix with its standard errors.
    n_modes
        How many.
    choice
        ``"first"``: the first ones. ``"snr"``: those with the highest signal-to-noise ratio; on open-loop
        data these are not the first, which carry the turbulence. ``"d-optimal"``: those that together make
        the volume of the registration's error ellipsoid smallest, ``"a-optimal"``: the sum of its variances
        in units of the longest step (:func:`choose_by_fisher_information`).
    model, start
        The synthetic model, and where to take its derivatives (zero by default); for the last two.

    Raises
    ------
    ValueError
        A choice by information without a model.
    """
    if modes_choice == "first":
        return np.arange(n_modes)
    if modes_choice == "snr":
        snr = matrix.snr()
        best = np.argsort(np.where(np.isfinite(snr), -snr, -np.inf), kind="stable")[:n_modes]
        return np.sort(best)
    if model is None:
        raise ValueError(f"modes are chosen '{modes_choice}' by their derivatives; hand over the model")
    by_mode = mode_information(matrix, model, start or Registration())
    return choose_by_fisher_information(by_mode, n_modes, modes_choice)


def mode_information(
    matrix: InteractionMatrix, model: SyntheticModel, start: Registration
) -> NDArray[np.float64]:
    """Fisher information of every mode on gain and registration ``(n_modes, 6, 6)``.

    With white noise the modes' information adds: ``F = sum_m J_m^T J_m``, ``J_m (n_slopes, 6)`` the
    derivatives of a column by the parameters, in standard errors.
    """
    problem = LeastSquaresProblem(WeightedMatrix.of(matrix, np.arange(matrix.n_modes)), model)
    projected_jacobian = problem.linearise(start.to_array(), np.zeros(5)).projected_jacobian()
    return np.asarray(np.einsum("psm,qsm->mpq", projected_jacobian, projected_jacobian))


def choose_by_fisher_information(
    by_mode: NDArray[np.float64], n_modes: int, modes_choice: ModesChoice
) -> NDArray[np.intp]:
    """Greedy choice of the modes that carry most information, in their own order.

    One after the other that mode is taken which leaves the smallest error: the greedy algorithm reaches
    63 % of the best gain in ``log det F`` at least (Nemhauser, Wolsey & Fisher 1978: it is submodular), and
    the optimum itself takes a search through all subsets.

    Parameters
    ----------
    by_mode
        From :func:`mode_information`.
    n_modes
        How many to take.
    choice
        ``"d-optimal"``: least ``log det`` of the registration's covariance, the gain being unknown;
        ``"a-optimal"``: least trace, in units of the longest step.
    """
    scale = np.append(1.0, MAX_STEP)
    information = by_mode * np.outer(scale, scale)
    total = np.diag(information.sum(axis=0))
    accumulated = np.diag(np.maximum(_PRIOR_INFORMATION * total, np.finfo(float).tiny))
    remaining, chosen = list(range(len(information))), []
    for _ in range(min(n_modes, len(remaining))):
        # The gain takes its share of the information away, whatever it is.
        covariance = np.linalg.inv(accumulated + information[remaining])[:, 1:, 1:]
        if modes_choice == "d-optimal":
            cost = np.linalg.slogdet(covariance)[1]
        else:
            cost = np.trace(covariance, axis1=1, axis2=2)
        best = remaining.pop(int(np.argmin(cost)))
        accumulated = accumulated + information[best]
        chosen.append(best)
    return np.sort(np.asarray(chosen, dtype=np.intp))
