"""Named arrangements of actuators."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: What a layout's name looks like.
PATTERN = r"^(circle|square)-[1-9][0-9]{0,2}$"


def _rows(layout: str) -> list[list[bool]]:
    if not re.match(PATTERN, layout):
        raise ValueError(f"layout {layout!r} is neither 'circle-N' nor 'square-N'")
    kind, size = layout.split("-")
    n = int(size)
    # Twice the distance from the centre stays whole for even n as well.
    axis = range(1 - n, n, 2)
    return [[kind == "square" or x * x + y * y < n * n for x in axis] for y in axis]


def count(layout: str) -> int:
    """Number of actuators of a layout.

    Raises
    ------
    ValueError
        The name is not a layout.
    """
    return sum(map(sum, _rows(layout)))


def actuator_map(layout: str) -> NDArray[np.bool_]:
    """Where the actuators stand.

    ``circle-N`` fills a circle of diameter N on an N x N grid: ``circle-11`` is the 97 actuators of
    the ALPAO DM97, with ``i**2 + j**2 < 5.5**2``. ``square-N`` fills the whole grid.

    Returns
    -------
    ndarray of bool, ``(N, N)``

    Raises
    ------
    ValueError
        The name is not a layout.
    """
    import numpy as np

    return np.array(_rows(layout), dtype=np.bool_)
