"""Reconstructors from interaction matrices."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import CalibrationError


def reconstructor(
    matrix: NDArray[np.floating],
    *,
    scale: NDArray[np.floating] | None = None,
    dropped_modes: int = 0,
) -> NDArray[np.float32]:
    """Truncated pseudo-inverse ``R = V Sigma^+(phi) U^T`` (paper) with the ``phi`` largest singular values.

    Returns ``(n_modes, n_slopes)``, float32.

    Parameters
    ----------
    matrix
        Interaction matrix ``(n_slopes, n_modes)``.
    scale
        Stroke per unit of each mode ``(n_modes,)``; by default equal. The singular values are those of slopes
        per stroke, so that the weakest eigenmodes need most stroke for least signal.
    dropped_modes
        Number of the weakest eigenmodes that are left out.

    Raises
    ------
    CalibrationError
        No eigenmode is left, or the matrix is singular or not finite.
    """
    if not np.isfinite(matrix).all():
        raise CalibrationError("the interaction matrix is not finite; measure it again")
    n_modes = matrix.shape[1]
    if not 0 <= dropped_modes < n_modes:
        raise CalibrationError(f"{dropped_modes} dropped modes of {n_modes} leave none; drop fewer")
    stroke = np.ones(n_modes) if scale is None else np.asarray(scale, dtype=np.float64)
    u, s, vt = np.linalg.svd(np.asarray(matrix, dtype=np.float64) / stroke, full_matrices=False)
    kept = slice(0, min(n_modes, s.size) - dropped_modes)
    if s[0] <= 0 or s[kept][-1] <= s[0] * 1e-12:
        raise CalibrationError(
            f"the interaction matrix is singular: eigenmode {s[kept].size} has no signal; "
            "drop more modes or measure it again"
        )
    inverse = s[kept] / s[kept] ** 2
    return np.ascontiguousarray((vt[kept].T * inverse) @ u[:, kept].T / stroke[:, None], dtype=np.float32)
