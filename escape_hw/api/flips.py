"""Orientations of a square: flips, quarter turns and transpositions of images and of actuator numberings."""

from __future__ import annotations

from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

#: A turn is from +x (columns) towards +y (rows), clockwise where rows are counted downwards.
Flip = Literal[
    "none", "left-right", "up-down", "turn-90", "turn-180", "turn-270", "transpose", "anti-transpose"
]
FLIPS: tuple[Flip, ...] = get_args(Flip)
#: Rows and columns exchanged, then mirrored along x (columns), then along y (rows).
_OPERATIONS: dict[Flip, tuple[bool, bool, bool]] = {
    "none": (False, False, False),
    "left-right": (False, True, False),
    "up-down": (False, False, True),
    "turn-90": (True, True, False),
    "turn-180": (False, True, True),
    "turn-270": (True, False, True),
    "transpose": (True, False, False),
    "anti-transpose": (True, True, True),
}
#: Largest difference between positions that count as equal, in units of the positions.
_SAME_POSITION = 1e-3


def exchanges_axes(flip: Flip) -> bool:
    """Whether a flip exchanges rows and columns."""
    return _OPERATIONS[flip][0]


def flip_image(image: NDArray[Any], flip: Flip) -> NDArray[Any]:
    """A view of an image ``(rows, columns)`` in another orientation."""
    transpose, flip_x, flip_y = _OPERATIONS[flip]
    return turn_image(image, transpose, flip_x, flip_y)


def turn_image(image: NDArray[Any], transpose: bool, flip_x: bool, flip_y: bool) -> NDArray[Any]:
    """A view of an image, transposed, then mirrored along x (columns) and y (rows)."""
    image = image.T if transpose else image
    image = image[:, ::-1] if flip_x else image
    return image[::-1] if flip_y else image


def flip_matrix(flip: Flip) -> NDArray[np.intp]:
    """Matrix ``(2, 2)`` that takes the offset (x, y) of a point from the image's centre to its new one."""
    transpose, flip_x, flip_y = _OPERATIONS[flip]
    x, y = -1 if flip_x else 1, -1 if flip_y else 1
    return np.array([[0, x], [y, 0]] if transpose else [[x, 0], [0, y]], dtype=np.intp)


def combine_flips(first: Flip, second: Flip) -> Flip:
    """The flip that has the effect of ``first``, then ``second``."""
    return _flip_of(flip_matrix(second) @ flip_matrix(first))


def inverse_flip(flip: Flip) -> Flip:
    """The flip that undoes a flip."""
    return _flip_of(flip_matrix(flip).T)


def _flip_of(matrix: NDArray[np.intp]) -> Flip:
    return next(flip for flip in FLIPS if np.array_equal(flip_matrix(flip), matrix))


def flip_order(positions: NDArray[np.float64], flip: Flip) -> NDArray[np.intp]:
    """Number in the layout of each actuator of a mirror that counts on a flipped map.

    Parameters
    ----------
    positions
        Positions of the actuators ``(n_act, 2)`` as (x, y) from the mirror's centre, in pitches.
    flip
        What makes the mirror's own map of numbers that of the layout.

    Raises
    ------
    ValueError
        The flip does not take the layout to itself.
    """
    flipped = positions @ flip_matrix(flip).T
    by_place, by_flipped_place = (np.lexsort(np.round(at, 3).T) for at in (positions, flipped))
    if np.abs(positions[by_place] - flipped[by_flipped_place]).max() > _SAME_POSITION:
        raise ValueError(f"the layout does not map onto itself by '{flip}'")
    order = np.empty(len(positions), dtype=np.intp)
    order[by_flipped_place] = by_place
    return order
