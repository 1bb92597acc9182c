"""Arrangements of actuators on a mirror and of sub-apertures on a sensor, as one line of text.

A layout is a name (``circle-11``), a list of rows (``rows:4,6,6,4``) or a file (``mask:FILE``,
``positions:FILE``). :func:`resolve_layout` replaces a file by its content, ``map:0110/1111`` or
``points:x,y;x,y``, so that a stored configuration does not depend on files.
"""

from __future__ import annotations

import math
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from escape_hw.bounded_files import MAX_TEXT_BYTES, read_bounded, reason_of
from escape_hw.errors import IncompatibleProduct, ProductError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

#: Actuators on each ring of the adaptive secondary mirrors, from the inside out. A ring of n actuators has a
#: radius of n / 6 pitches, so rings are 1 pitch apart and actuators 1.05 pitches along them. 672 is the
#: arrangement of the LBT mirrors; 336 is an early guess of the MMT's, replaced by ``maps-336``.
RINGS = {
    336: tuple(range(21, 64, 6)),
    672: tuple(range(9, 88, 6)),
}
#: Rings of the MMT's adaptive secondary: number of actuators, radius in pupil radii, and steps by which the
#: first one lies before +x. To 0.001 those of CACAO's example MAPS-vispyr-conf (act2Dpos.txt).
MAPS_RINGS = (
    (6, 0.1315, 0.0), (12, 0.2286, 2.0), (18, 0.3264, 3.0), (24, 0.4242, 4.0), (30, 0.5218, 5.0),
    (36, 0.6192, 6.0), (42, 0.7170, 7.0), (48, 0.8147, 8.0), (60, 0.9060, 10.5), (60, 0.9755, 11.0),
)  # fmt: skip
#: Pitches in the radius of the pupil: the MMT's rings are 0.0976 radii apart.
MAPS_PITCHES = 10.25
#: Largest number of rows or columns, and of positions.
_MAX_SIZE, _MAX_POINTS = 1000, 10000
#: What a layout may be, for messages.
FORMS = (
    "'circle-N', 'square-N', 'rings-672', 'maps-336', 'rows:5,7,7,5' (actuators per row), 'mask:FILE' or "
    "'positions:FILE' (text, .npy or .fits)"
)


class _Layout(NamedTuple):
    """A parsed layout: rows of a map, or positions ``(x, y)``; the other is ``None``."""

    rows: list[list[bool]] | None
    points: list[tuple[float, float]] | None


def resolve_layout(layout: str) -> str:
    """The layout with the content of its file in place of the file's name.

    Raises
    ------
    ValueError
        Unknown layout, or a file that cannot be read; the message names the value and the remedy.
    """
    kind, _, rest = layout.partition(":")
    if kind == "mask":
        table = _read_table(rest, "mask")
        rows = ["".join("1" if value else "0" for value in row) for row in table]
        layout = "map:" + "/".join(rows)
    elif kind == "positions":
        layout = "points:" + ";".join(f"{x:.9g},{y:.9g}" for x, y in _ordered_points(_read_table(rest), rest))
    _parse(layout)
    return layout


@lru_cache(maxsize=32)
def _parse(layout: str) -> _Layout:
    kind, colon, rest = layout.partition(":")
    if not colon:
        return _parse_name(layout)
    if kind == "rows":
        return _Layout(_rows_of_counts(rest), None)
    if kind == "map":
        return _Layout(_rows_of_map(rest), None)
    if kind == "points":
        return _Layout(None, _points(rest))
    raise ValueError(f"layout {layout[:40]!r} is unknown; choose {FORMS}")


def _parse_name(layout: str) -> _Layout:
    if layout == "maps-336":
        return _Layout(None, _maps_positions())
    kind, _, size = layout.partition("-")
    n = int(size) if size.isdecimal() and len(size) <= 3 and not size.startswith("0") else 0
    if kind == "rings" and n in RINGS:
        return _Layout(None, _ring_positions(RINGS[n]))
    if kind not in ("circle", "square") or not n:
        raise ValueError(f"layout {layout[:40]!r} is unknown; choose {FORMS}")
    # In half pitches, so that coordinates are integers for even n too.
    axis = range(1 - n, n, 2)
    return _Layout([[kind == "square" or x * x + y * y < n * n for x in axis] for y in axis], None)


def _rows_of_counts(text: str) -> list[list[bool]]:
    """Rows of a map from the number of elements in each, centred."""
    try:
        counts = [int(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"layout 'rows:{text[:40]}' must list whole numbers, as in 'rows:5,7,7,5'") from None
    width = max(counts)
    if min(counts) < 0 or not 0 < width <= _MAX_SIZE or len(counts) > _MAX_SIZE:
        raise ValueError(f"layout 'rows:{text[:40]}': rows have 0 to {_MAX_SIZE} elements, and one at least")
    for number, count in enumerate(counts, 1):
        if (width - count) % 2:
            raise ValueError(
                f"layout 'rows:{text[:40]}': row {number} of {count} cannot be centred on a grid of {width} "
                "columns; correct the count, or give the map by 'mask:FILE'"
            )
    return [[abs(2 * column - width + 1) < count for column in range(width)] for count in counts]


def _rows_of_map(text: str) -> list[list[bool]]:
    rows = text.split("/")
    if set(text) - set("01/") or len({len(row) for row in rows}) != 1 or "1" not in text:
        raise ValueError(f"layout 'map:{text[:40]}' must have rows of equal length, as in 'map:0110/1111'")
    if max(len(rows), len(rows[0])) > _MAX_SIZE:
        raise ValueError(
            f"the map has {len(rows)} x {len(rows[0])} elements; at most {_MAX_SIZE} are allowed"
        )
    return [[mark == "1" for mark in row] for row in rows]


def _points(text: str) -> list[tuple[float, float]]:
    try:
        points = [(float(x), float(y)) for x, y in (pair.split(",") for pair in text.split(";"))]
    except ValueError:
        raise ValueError(f"layout 'points:{text[:40]}' must list x,y;x,y") from None
    if len(points) > _MAX_POINTS:
        raise ValueError(f"the layout has {len(points)} positions; at most {_MAX_POINTS} are allowed")
    seen: dict[tuple[float, float], int] = {}
    for number, point in enumerate(points):
        if not all(map(math.isfinite, point)):
            raise ValueError(f"actuator {number} of the layout is at {point}; positions must be finite")
        if point in seen:
            raise ValueError(
                f"actuators {seen[point]} and {number} of the layout have the same position {point}"
            )
        seen[point] = number
    return points


def _on_ring(n: int, radius: float, steps_before: float) -> list[tuple[float, float]]:
    """Positions on a ring from +x towards +y, beginning some steps before +x."""
    angles = [2 * math.pi * (k - steps_before) / n for k in range(n)]
    return [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]


def _ring_positions(rings: tuple[int, ...]) -> list[tuple[float, float]]:
    return [at for n in rings for at in _on_ring(n, n / 6, -0.5)]


def _maps_positions() -> list[tuple[float, float]]:
    at = [at for n, radius, before in MAPS_RINGS for at in _on_ring(n, radius * MAPS_PITCHES, before)]
    # The published numbering ends with the sixth actuator of the innermost ring.
    return [*at[:5], *at[6:], at[5]]


def _read_table(name: str, what: str = "table of positions") -> list[list[float]]:
    """Rows of numbers of a text, .npy or .fits file."""
    import numpy as np

    path = Path(name).expanduser()
    try:
        content = read_bounded(path, MAX_TEXT_BYTES * 10)
        table = np.asarray(_decode_table(content), dtype=np.float64)
    except Exception as error:
        # NumPy and astropy raise errors of many kinds for damaged files.
        raise ValueError(f"the {what} {name!r} cannot be read ({reason_of(error)})") from error
    if table.ndim != 2 or not table.size:
        raise ValueError(f"the {what} {name!r} has shape {table.shape}; it needs rows and columns")
    rows: list[list[float]] = table.tolist()
    return rows


def read_numbers(name: str) -> list[int]:
    """Whole numbers of a text, .npy or .fits file, row by row; raises :class:`ValueError` for others."""
    import numpy as np

    from escape_hw.array_files import read_array

    try:
        numbers = np.asarray(read_array(Path(name).expanduser()), dtype=np.float64).ravel()
    except (ProductError, ValueError, TypeError) as error:
        raise ValueError(f"the table of numbers {error}") from error
    if numbers.size > _MAX_POINTS or not np.array_equal(numbers, np.round(numbers)):
        raise ValueError(
            f"the table of numbers {name!r} must have a whole number per actuator, {_MAX_POINTS} at most"
        )
    return [int(number) for number in numbers]


def _decode_table(content: bytes) -> Any:
    if content.startswith((b"\x93NUMPY", b"SIMPLE")):
        from escape_hw.array_files import decode_array

        return decode_array(content, n_axes=2)
    lines = [line.partition("#")[0].replace(",", " ") for line in content.decode("utf-8").splitlines()]
    rows = [line.split() for line in lines if line.strip()]
    # A mask may be written without spaces.
    if all(len(row) == 1 and set(row[0]) <= {"0", "1"} for row in rows):
        rows = [list(row[0]) for row in rows]
    return [[float(value) for value in row] for row in rows]


def _ordered_points(table: list[list[float]], name: str) -> list[tuple[float, float]]:
    """Positions from columns x, y or number, x, y; numbers count from 0 or 1."""
    width = len(table[0])
    if width == 3:
        table = sorted(table)
        first = table[0][0]
        if first not in (0, 1) or [row[0] for row in table] != [first + k for k in range(len(table))]:
            raise ValueError(
                f"the table of positions {name!r} must number its {len(table)} actuators from 0 or 1 in the "
                "first column, without gaps or repetitions"
            )
        table = [row[1:] for row in table]
    elif width != 2:
        raise ValueError(
            f"the table of positions {name!r} has {width} columns; it needs x, y or number, x, y"
        )
    return [(x, y) for x, y in table]


def is_on_grid(layout: str) -> bool:
    """Whether the elements are on a square grid; raises :class:`ValueError` for an unknown layout."""
    return _parse(layout).rows is not None


def n_actuators(layout: str) -> int:
    """Number of actuators; raises :class:`ValueError` for an unknown layout."""
    rows, points = _parse(layout)
    return sum(map(sum, rows)) if rows is not None else len(points or ())


def map_shape(layout: str) -> tuple[int, int] | None:
    """Rows and columns of the map; ``None`` without a grid."""
    rows = _parse(layout).rows
    return None if rows is None else (len(rows), len(rows[0]))


def layout_map(layout: str) -> NDArray[np.bool_]:
    """Map of the actuators, or sub-apertures, on their grid.

    ``circle-N`` fills a circle of diameter N on an N x N grid: ``circle-11`` is the 97 actuators of
    the ALPAO DM97, with ``i**2 + j**2 < 5.5**2``. ``square-N`` fills the whole grid.

    Returns
    -------
    ndarray of bool, ``(n_rows, n_columns)``

    Raises
    ------
    ValueError
        Unknown layout, or a layout without a grid.
    """
    import numpy as np

    rows = _parse(layout).rows
    if rows is None:
        raise ValueError(f"layout {shorten(layout)!r} is not on a grid")
    return np.array(rows, dtype=np.bool_)


def positions(layout: str) -> NDArray[np.float64]:
    """Actuator positions from the centre of the mirror.

    On a grid the numbering is row-major. On rings it goes from the inside out and along each ring from +x
    towards +y, beginning half a step away from +x; ``maps-336`` has the numbering of its published table.

    Returns
    -------
    ndarray, ``(n_act, 2)``
        As (x, y), in pitches; those of a table in the table's unit.

    Raises
    ------
    ValueError
        Unknown layout.
    """
    import numpy as np

    points = _parse(layout).points
    if points is not None:
        return np.array(points)
    return grid_positions(layout_map(layout))


def grid_positions(grid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Positions ``(n_act, 2)`` (x, y) of the actuators of a map, row by row, in pitches from its centre."""
    import numpy as np

    rows, columns = np.nonzero(grid)
    return np.stack([columns, rows], axis=1) - (np.array(grid.shape[::-1]) - 1) / 2


def require_same_positions(measured: str, present: str, subject: str) -> None:
    """Refuse a matrix of actuators at other positions than those of the mirror in use.

    Positions are compared up to their unit, so that a corrected pitch does not matter.

    Parameters
    ----------
    measured, present
        Layout of the matrix, accepted if it is empty or of no known form, and ``devices.dm.layout``.
    subject
        What the message begins with.

    Raises
    ------
    IncompatibleProduct
        The positions differ.
    """
    import numpy as np

    if not measured or measured == present:
        return
    try:
        theirs = positions(measured)
    except ValueError:
        return
    ours = positions(present)
    if theirs.shape != ours.shape or not np.allclose(theirs / theirs.std(), ours / ours.std(), atol=1e-6):
        raise IncompatibleProduct(
            f"{subject} was measured with the layout {shorten(measured)!r} of {len(theirs)} actuators; "
            f"devices.dm.layout is {shorten(present)!r}, with other positions: measure the matrix again"
        )


def shorten(layout: str) -> str:
    """The layout for a message: its first characters if it lists many positions."""
    return layout if len(layout) <= 60 else layout[:57] + "..."
