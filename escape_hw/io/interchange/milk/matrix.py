"""A calibration as images of milk's: cubes of maps, as CACAO keeps modes and responses."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.results import CalibrationResult
from escape_hw.io.fits.extensions import reference_slopes


def calibration_images(
    result: CalibrationResult, actuator_map: NDArray[np.bool_] | None
) -> dict[str, NDArray[Any]]:
    """The calibration as arrays by the ending of their names.

    ``actuator_map`` is ``None`` where the actuators are not on a grid.

    Returns
    -------
    dict
        ``wfs``: slopes per unit mode ``(n_modes, 2 n_rows, n_columns)``, x above y, 0 where nothing is valid.
        ``dm``: the modes ``(n_modes, rows, columns)`` in fractions of full stroke, or ``(n_modes, n_act)``.
        ``mask``: the valid slopes ``(2 n_rows, n_columns)``. ``ref``: reference slopes of the same shape.
    """
    matrix, grid = result.matrix, result.grid
    mask = np.vstack([matrix.valid, matrix.valid])
    wfs = np.zeros((matrix.n_modes, *mask.shape), np.float32)
    wfs[:, mask] = matrix.data.T
    modes = matrix.m2c.T.astype(np.float32)
    if actuator_map is not None:
        dm = np.zeros((matrix.n_modes, *actuator_map.shape), np.float32)
        dm[:, actuator_map] = modes
        modes = dm
    references = np.zeros(mask.shape, np.float32)
    references[mask] = reference_slopes(grid).T.ravel()
    return {"wfs": wfs, "dm": modes, "mask": mask.astype(np.uint8), "ref": references}
