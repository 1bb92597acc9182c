"""The Cramer-Rao bound of a registration from a whitened DO-CRIME run."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.matrix import InteractionMatrix
from escape_hw.api.model import SyntheticModel
from escape_hw.api.registration import Registration
from escape_hw.calibration.derivatives import modal_jacobian

#: Share of the diagonal mixed into the noise covariance, so that few frames leave it invertible.
_SHRINKAGE = 0.05


def registration_bound(
    matrix: InteractionMatrix,
    covariance: NDArray[np.float64],
    model: SyntheticModel,
    registration: Registration,
) -> NDArray[np.float64]:
    """Least standard errors ``(5,)`` that any unbiased estimator can reach on these frames.

    Gain and registration are the only unknowns: the model is taken as exact and the whitened noise
    as Gaussian with the covariance found. The Fisher information of frames with pokes ``c`` and
    noise ``N(0, C)`` is ``F_pq = sum_t (J_p c_t)^T C^-1 (J_q c_t)``, with ``J_p`` the derivative of
    the matrix by parameter ``p``; pokes are white, so their second moments are diagonal.

    Parameters
    ----------
    matrix
        The measured matrix; its standard errors tell how strongly each mode was excited.
    covariance
        Covariance of one frame's whitened residual slopes ``(n_slopes, n_slopes)``.
    model
        The synthetic model on the same grid.
    registration
        Where to take the bound.
    """
    variance = np.diag(covariance)
    excitation = np.mean(variance[:, None] / np.square(matrix.sigma, dtype=float), axis=0)
    mixed = (1 - _SHRINKAGE) * covariance + _SHRINKAGE * np.diag(variance)
    unit, derivatives = modal_jacobian(model, registration, matrix.m2c)
    gain = float(np.vdot(unit, matrix.data) / np.vdot(unit, unit))
    jacobian = np.concatenate([unit[None], gain * derivatives[:5]]) * np.sqrt(excitation)
    whitened = np.linalg.solve(np.linalg.cholesky(mixed), jacobian.transpose(1, 0, 2).reshape(len(mixed), -1))
    columns = whitened.reshape(len(mixed), 6, -1).transpose(1, 0, 2).reshape(6, -1)
    return np.asarray(np.sqrt(np.diag(np.linalg.inv(columns @ columns.T)))[1:6])
