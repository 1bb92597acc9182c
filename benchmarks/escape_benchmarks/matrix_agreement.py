"""Agreement of two matrices, for the studies of measured ones."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


def remaining(measured: NDArray[np.floating], predicted: NDArray[np.floating]) -> float:
    """Rms of the difference relative to the measured matrix, after the best common gain."""
    gain = np.vdot(predicted, measured) / np.vdot(predicted, predicted)
    return float(np.linalg.norm(measured - gain * predicted) / np.linalg.norm(measured))


def correlation(a: NDArray[np.floating], b: NDArray[np.floating]) -> float:
    """Correlation of two matrices about zero."""
    return float(np.vdot(a, b) / np.sqrt(np.vdot(a, a) * np.vdot(b, b)))
