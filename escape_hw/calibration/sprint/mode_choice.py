"""Choice of the modes that SPRINT fits: by signal-to-noise ratio, by order, or by Fisher information."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.registration import Registration
from escape_hw.api.synthetic_model import SyntheticModel
from escape_hw.calibration.sprint.least_squares import MAX_STEP, LeastSquaresProblem
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix
from escape_hw.config.choices import ModesChoice

#: Initial information on every parameter, relative to that of all modes: a single mode does not determine
#: all parameters.
_PRIOR_INFORMATION = 1e-6


def choose_modes(
    matrix: InteractionMatrix,
    n_modes: int,
    modes_choice: ModesChoice = "snr",
    model: SyntheticModel | None = None,
    start: Registration | None = None,
) -> NDArray[np.intp]:
    """Choose the modes to fit; in ascending order.

    Parameters
    ----------
    matrix, n_modes
        The measured matrix with its standard errors, and number of modes to choose.
    modes_choice
        ``"first"``: the first ones. ``"snr"``: those with the highest signal-to-noise ratio; on open-loop
        data these are not the first, which contain most of the turbulence. Without standard errors those with
        the largest slopes. ``"d-optimal"``: those that
        minimise the volume of the error ellipsoid of the registration; ``"a-optimal"``: the sum of its
        variances in units of the largest step (:func:`choose_by_fisher_information`).
    model, start
        The synthetic model, and the registration at which it is differentiated (zero by default); for the
        last two.

    Raises
    ------
    ValueError
        A choice by Fisher information without a model.
    """
    if modes_choice == "first":
        return np.arange(n_modes)
    if modes_choice == "snr":
        snr = matrix.snr()
        if not np.isfinite(snr).all():
            # Without standard errors the noise is taken as equal, as in the fit.
            snr = np.square(matrix.data, dtype=float).mean(axis=0)
        return np.sort(np.argsort(-snr, kind="stable")[:n_modes])
    if model is None:
        raise ValueError(f"modes_choice = '{modes_choice}' needs the derivatives of the model; pass model=")
    by_mode = mode_information(matrix, model, start or Registration())
    return choose_by_fisher_information(by_mode, n_modes, modes_choice)


def mode_information(
    matrix: InteractionMatrix, model: SyntheticModel, start: Registration
) -> NDArray[np.float64]:
    """Fisher information of every mode on gain and registration ``(n_modes, 6, 6)``.

    For white noise the information of the modes adds: ``F = sum_m J_m^T J_m``, with ``J_m (n_slopes, 6)``
    the derivatives of a column by the parameters, in standard errors.
    """
    problem = LeastSquaresProblem(WeightedMatrix.from_columns(matrix, np.arange(matrix.n_modes)), model)
    projected_jacobian = problem.linearise(start.to_array(), np.zeros(5)).projected_jacobian()
    return np.asarray(np.einsum("psm,qsm->mpq", projected_jacobian, projected_jacobian))


def choose_by_fisher_information(
    by_mode: NDArray[np.float64], n_modes: int, modes_choice: ModesChoice
) -> NDArray[np.intp]:
    """Greedy choice of the most informative modes, in ascending order.

    Each step adds the mode that minimises the error. The greedy algorithm reaches at least 63 % of the
    largest possible increase of ``log det F``, which is submodular (Nemhauser, Wolsey & Fisher 1978); the
    optimum would need a search through all subsets.

    Parameters
    ----------
    by_mode, n_modes
        Information from :func:`mode_information`, and number of modes to choose.
    modes_choice
        ``"d-optimal"``: smallest ``log det`` of the covariance of the registration, with unknown gain;
        ``"a-optimal"``: smallest trace, in units of the largest step.
    """
    scale = np.append(1.0, MAX_STEP)
    information = by_mode * np.outer(scale, scale)
    total = np.diag(information.sum(axis=0))
    accumulated = np.diag(np.maximum(_PRIOR_INFORMATION * total, np.finfo(float).tiny))
    remaining, chosen = list(range(len(information))), []
    for _ in range(min(n_modes, len(remaining))):
        # Covariance of the registration with unknown gain.
        covariance = np.linalg.inv(accumulated + information[remaining])[:, 1:, 1:]
        if modes_choice == "d-optimal":
            cost = np.linalg.slogdet(covariance)[1]
        else:
            cost = np.trace(covariance, axis1=1, axis2=2)
        best = remaining.pop(int(np.argmin(cost)))
        accumulated = accumulated + information[best]
        chosen.append(best)
    return np.sort(np.asarray(chosen, dtype=np.intp))
