"""What pyRTC 1.x meant by its files, in the conventions of 2.x.

Two things changed with 2.0: frames are indexed (y, x), where some camera adapters used to transpose them,
and pixel k of a sub-aperture of n pixels lies at ``k - (n - 1) / 2`` instead of ``k - n // 2``.
A file of 1.x does not tell; whoever made it says ``"yx"`` (frames as the camera gave them), ``"xy"``
(transposed by the adapter) or ``"as_is"`` (already as 2.x has it).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.errors import ConfigError, IncompatibleProduct
from escape_hw.io.interchange.pyrtc_file import PyrtcFile

LEGACY = ("yx", "xy", "as_is")


@dataclass(frozen=True, slots=True)
class LegacyFrame:
    """How files of pyRTC 1.x were made.

    Parameters
    ----------
    way
        ``"yx"``, ``"xy"`` or ``"as_is"``.
    pyramid
        Whether the sensor is a pyramid.
    window
        Pixels across a lenslet's window; 0 for a pyramid.
    default_pupils
        The pupil images stood where pyRTC puts them by itself. Transposing exchanges two of them.

    Raises
    ------
    ConfigError
        There is no such way.
    """

    way: str
    pyramid: bool = False
    window: int = 0
    default_pupils: bool = False

    def __post_init__(self) -> None:
        if self.way not in LEGACY:
            raise ConfigError(f"--legacy {self.way}: it is one of {', '.join(LEGACY)}")

    def map(self, slope_map: NDArray[Any]) -> NDArray[Any]:
        """A slope map or mask as 2.x has it: ``(2 N, N)``, x above y; a pyramid's ``(2 R, 4 R)``."""
        if self.way != "xy":
            return slope_map
        if self.pyramid:
            x, y = np.hsplit(slope_map, 2)
            return np.hstack([y.T, x.T] if self.default_pupils else [x.T, y.T])
        # With rows and columns exchanged, what was called x is y.
        x, y = np.vsplit(slope_map, 2)
        return np.vstack([y.T, x.T])

    def references(self, references: NDArray[Any]) -> NDArray[np.float32]:
        """Reference slopes as 2.x has them: even windows were centred half a pixel off."""
        moved = self.map(np.asarray(references, np.float32))
        off = self.way != "as_is" and not self.pyramid and self.window % 2 == 0
        return moved + np.float32(0.5) if off else moved

    def matrix(self, matrix: NDArray[Any], old_valid: NDArray[np.bool_]) -> NDArray[Any]:
        """An interaction matrix ``(n_slopes, n_modes)`` with its rows in the order of 2.x.

        Parameters
        ----------
        matrix
            As 1.x had it.
        old_valid
            The mask it was made with, as 1.x had it.
        """
        numbers = np.full(old_valid.shape, -1)
        numbers[tuple(places(old_valid, self.pyramid))] = np.arange(int(old_valid.sum()))
        moved = self.map(numbers)
        return np.asarray(matrix[moved[tuple(places(moved >= 0, self.pyramid))]])


def require_way(file: PyrtcFile, way: str | None) -> str:
    """How a file of pyRTC 1.x was made, as stated.

    Raises
    ------
    IncompatibleProduct
        Nobody said.
    """
    if way is None:
        raise IncompatibleProduct(
            f"{file.path}: a file of pyRTC 1.x, which does not say how its frames lay; say it with "
            "--legacy yx (frames as the camera gave them), xy (transposed by pyRTC's camera adapter) or "
            "as_is (already as 2.x has it)"
        )
    return way


def places(valid: NDArray[np.bool_], pyramid: bool) -> NDArray[np.intp]:
    """Where the slopes of a signal stand in pyRTC's map, rows and columns ``(2, n_slopes)``.

    All x come first, each row by row: a Shack-Hartmann map has y below, a pyramid's beside.
    """
    if not pyramid:
        return np.array(np.nonzero(valid))
    half = valid.shape[1] // 2
    rows, columns = np.nonzero(valid[:, :half])
    return np.array([np.r_[rows, rows], np.r_[columns, columns + half]])
