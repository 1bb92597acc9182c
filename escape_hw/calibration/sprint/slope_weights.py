"""Sub-apertures that do not fit in with the others, or that no model is of: less weight for them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.synthetic_model import HasSlopeWeights, SyntheticModel
from escape_hw.calibration.sprint.weighted_matrix import WeightedMatrix

#: Residual of a sub-aperture, relative to the median one, up to which it counts in full.
_HUBER_THRESHOLD = 1.5
#: Rounds of weighing and fitting; the weights hardly move after the second.
HUBER_ITERATIONS = 3


def apply_model_weights(weighted: WeightedMatrix, model: SyntheticModel) -> WeightedMatrix:
    """A matrix with slopes that a model is no model of counting less.

    Parameters
    ----------
    weighted
        The measured matrix.
    model
        Says which (:class:`~escape_hw.api.synthetic_model.HasSlopeWeights`); one that does not say is of all.
    """
    return (
        weighted.with_slope_weights(model.slope_weights) if isinstance(model, HasSlopeWeights) else weighted
    )


def huber_weights(residual: NDArray[np.float64]) -> NDArray[np.float64]:
    """Weight of every slope's squares ``(n_slopes,)``, in (0, 1].

    Huber's weights (1964), for sub-apertures instead of elements: dirt, a broken lenslet or a wrong window
    spoil one in all modes and in both slopes.

    Parameters
    ----------
    residual
        What a fit leaves ``(n_slopes, n_modes)`` in standard errors, all x then all y.
    """
    by_place = np.square(residual).mean(axis=1).reshape(2, -1).mean(axis=0)
    size = np.sqrt(by_place / max(float(np.median(by_place)), 1e-300))
    return np.tile(np.minimum(1.0, _HUBER_THRESHOLD / np.maximum(size, 1e-300)), 2)
