"""Named arrangements of actuators on a mirror."""

from __future__ import annotations

import math
import re
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Actuators on each ring of the adaptive secondary mirrors, from the inside out. A ring of n actuators has a
#: radius of n / 6 pitches, so rings are 1 pitch apart and actuators 1.05 pitches along them. 672 is the
#: arrangement of the LBT mirrors. The rings of the 336 actuators of the MMT mirror are not published; eight
#: rings in the same progression are chosen here, with a central hole of 6 pitches.
RINGS = {
    336: tuple(range(21, 64, 6)),
    672: tuple(range(9, 88, 6)),
}
#: Pattern of the names of layouts.
PATTERN = rf"^((circle|square)-[1-9][0-9]{{0,2}}|rings-({'|'.join(map(str, RINGS))}))$"


def _rows(layout: str) -> list[list[bool]]:
    kind, n = _parse(layout)
    if kind == "rings":
        raise ValueError(f"layout {layout!r} is on rings, not on a grid")
    # In half pitches, so that coordinates are integers for even n too.
    axis = range(1 - n, n, 2)
    return [[kind == "square" or x * x + y * y < n * n for x in axis] for y in axis]


def _parse(layout: str) -> tuple[str, int]:
    if not re.fullmatch(PATTERN, layout):
        known = ", ".join(f"'rings-{n}'" for n in RINGS)
        raise ValueError(f"layout {layout!r} is none of 'circle-N', 'square-N', {known}")
    kind, size = layout.split("-")
    return kind, int(size)


def is_on_grid(layout: str) -> bool:
    """Whether the actuators are on a square grid; raises :class:`ValueError` for an unknown layout."""
    return _parse(layout)[0] != "rings"


def n_actuators(layout: str) -> int:
    """Number of actuators; raises :class:`ValueError` for an unknown layout."""
    kind, n = _parse(layout)
    return n if kind == "rings" else sum(map(sum, _rows(layout)))


def actuator_map(layout: str) -> NDArray[np.bool_]:
    """Map of the actuators on their grid.

    ``circle-N`` fills a circle of diameter N on an N x N grid: ``circle-11`` is the 97 actuators of
    the ALPAO DM97, with ``i**2 + j**2 < 5.5**2``. ``square-N`` fills the whole grid.

    Returns
    -------
    ndarray of bool, ``(N, N)``

    Raises
    ------
    ValueError
        Unknown layout, or a layout without a grid.
    """
    import numpy as np

    return np.array(_rows(layout), dtype=np.bool_)


def positions(layout: str) -> NDArray[np.float64]:
    """Actuator positions from the centre of the mirror, in pitches.

    On a grid the numbering is row-major. On rings it goes from the inside out and along each ring from +x
    towards +y, beginning half a step away from +x.

    Returns
    -------
    ndarray, ``(n_act, 2)``
        As (x, y).

    Raises
    ------
    ValueError
        Unknown layout.
    """
    import numpy as np

    if is_on_grid(layout):
        grid = actuator_map(layout)
        rows, columns = np.nonzero(grid)
        return np.stack([columns, rows], axis=1) - (np.array(grid.shape[::-1]) - 1) / 2
    rings = RINGS[n_actuators(layout)]
    angle = np.concatenate([2 * math.pi * (np.arange(n) + 0.5) / n for n in rings])
    radius = np.repeat(np.array(rings) / 6, rings)
    return np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=1)
