"""What a synthetic model does not know: random effects that SPRINT fits beside the registration.

Each effect has a prior of zero mean (its scatter among instruments of a kind), so that the data
decide how much of it there is, and the registration's error bars include it.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True, slots=True)
class Priors:
    """Prior scatter of the model's unknowns, relative (rms).

    Parameters
    ----------
    actuator_gain
        Gains of single actuators.
    actuator_width
        Widths of single influence functions.
    slope_gain
        Gains of single slopes: uneven light, spot size and alignment with the pixels.
    sampling
        Where within its lenslet a slope samples the wavefront, in % of a sub-aperture; common to the
        x slopes of a column and to the y slopes of a row, which fall on the pixels alike.
    width, shape
        Common width of the influence functions, and the share of a broad pedestal in them.
    """

    actuator_gain: float = 0.1
    actuator_width: float = 0.05
    slope_gain: float = 0.1
    width: float = 0.2
    shape: float = 0.2
    sampling: float = 0.5


@dataclass(slots=True, eq=False)
class NormalEquations:
    """Gauss-Newton system of one linearisation, in units of the data's standard errors.

    The unknowns are, in order: the common parameters (gain, five of the registration, width, shape,
    shares of the model's variants, sampling positions), actuator gains, actuator widths, slope gains.
    """

    matrix: NDArray[np.float64]
    right: NDArray[np.float64]
    common: NDArray[np.float64]
    slopes_gain: NDArray[np.float64]
    slopes_width: NDArray[np.float64]
    modes: NDArray[np.float64]
    model: NDArray[np.float64]
    residual: NDArray[np.float64]
    n_common: int

    def efficient(self) -> NDArray[np.float64]:
        """Derivatives by the common parameters, less what the random effects can imitate.

        Returns
        -------
        ndarray, ``(n_common, n_slopes, n_modes)``
        """
        k = self.n_common
        n_act = self.modes.shape[0]
        imitation = np.linalg.solve(self.matrix[k:, k:], self.matrix[k:, :k])
        out = np.empty_like(self.common)
        for p in range(k):
            by_gain, by_width, by_slope = np.split(imitation[:, p], [n_act, 2 * n_act])
            out[p] = self.common[p] - (self.slopes_gain * by_gain + self.slopes_width * by_width) @ self.modes
            out[p] -= by_slope[:, None] * self.model
        return out


def normal_equations(
    common: NDArray[np.float64],
    slopes_gain: NDArray[np.float64],
    slopes_width: NDArray[np.float64],
    modes: NDArray[np.float64],
    model: NDArray[np.float64],
    residual: NDArray[np.float64],
    precision: NDArray[np.float64],
    offset: NDArray[np.float64],
) -> NormalEquations:
    """Assemble the system; no array of the size of all derivatives is ever formed.

    Parameters
    ----------
    common
        Weighted derivatives by the common parameters ``(n_common, n_slopes, n_modes)``.
    slopes_gain, slopes_width
        Weighted zonal matrices ``(n_slopes, n_act)``: derivative by an actuator's gain or width is the
        outer product of its column and its row of ``modes``.
    modes
        Weighted mode-to-command matrix ``(n_act, n_modes)``.
    model, residual
        Weighted model and residual ``(n_slopes, n_modes)``.
    precision
        Prior precision of every unknown.
    offset
        Present value of every unknown minus its prior mean.
    """
    k = common.shape[0]
    flat = common.reshape(k, -1)
    zonal = (slopes_gain, slopes_width)
    overlap = modes @ modes.T
    acting = np.block([[(a.T @ b) * overlap for b in zonal] for a in zonal])
    onto_modes = np.einsum("psm,am->psa", common, modes, optimize=True)
    common_acting = np.concatenate([np.einsum("psa,sa->pa", onto_modes, z) for z in zonal], axis=1)
    model_modes = model @ modes.T
    slope_acting = np.concatenate([model_modes * z for z in zonal], axis=1)
    slope_common = np.einsum("sm,psm->sp", model, common)
    matrix = np.block(
        [
            [flat @ flat.T, common_acting, slope_common.T],
            [common_acting.T, acting, slope_acting.T],
            [slope_common, slope_acting, np.diag(np.square(model).sum(axis=1))],
        ]
    )
    residual_modes = residual @ modes.T
    right = np.concatenate(
        [
            flat @ residual.ravel(),
            *(np.einsum("sa,sa->a", z, residual_modes) for z in zonal),
            np.einsum("sm,sm->s", model, residual),
        ]
    )
    matrix[np.diag_indices_from(matrix)] += precision
    return NormalEquations(
        matrix, right - precision * offset, common, slopes_gain, slopes_width, modes, model, residual, k
    )
