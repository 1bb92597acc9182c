"""Offsets of a mirror and of the reference slopes of a loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.api.representation import short_repr
from escape_hw.errors import IncompatibleProduct


@dataclass(frozen=True, slots=True, eq=False)
class Offsets:
    """Shape that is added to a mirror at rest, and to what a loop converges to.

    Parameters
    ----------
    terms
        The offsets by name, in nm rms wavefront: ``tip``, ``tilt``, ``focus``, ``mode 12`` (from 1).
    modes
        Their sum as modal coefficients ``(n_modes,)``; empty without terms.
    slopes
        Measured offset of the reference slopes as maps of x and y ``(2, rows, columns)``, zero where there is
        none; empty if none was measured.
    flat
        Command of the flat shape without terms ``(n_act,)``, fraction of full stroke; empty: zeros.
    """

    terms: Mapping[str, float] = field(default_factory=dict)
    modes: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    slopes: NDArray[np.float32] = field(default_factory=lambda: np.zeros((2, 0, 0), np.float32))
    flat: NDArray[np.float64] = field(default_factory=lambda: np.zeros(0))
    __repr__ = short_repr

    def reference_slopes(self, matrix: InteractionMatrix) -> NDArray[np.float32]:
        """Offset of the reference slopes ``(n_slopes,)`` of a loop that is closed with a matrix.

        Raises
        ------
        IncompatibleProduct
            The offsets belong to another basis or sensor.
        """
        total = np.zeros(matrix.n_slopes, np.float32)
        if self.modes.size:
            if self.modes.size != matrix.n_modes:
                raise IncompatibleProduct(
                    f"the offsets are of {self.modes.size} modes, the matrix has {matrix.n_modes}; set "
                    "them again"
                )
            total += (matrix.data @ self.modes).astype(np.float32)
        if self.slopes.size:
            if self.slopes.shape[1:] != matrix.valid.shape:
                raise IncompatibleProduct(
                    f"the reference slopes are of {self.slopes.shape[1:]} sub-apertures, the matrix of "
                    f"{matrix.valid.shape}; measure them again, or clear them"
                )
            total += self.slopes[:, matrix.valid].ravel()
        return total
