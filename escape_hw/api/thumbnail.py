"""Small pictures and tables for notebooks, made without a plotting library."""

from __future__ import annotations

import base64
import struct
import zlib
from collections.abc import Mapping, Sequence
from html import escape

import numpy as np
from numpy.typing import ArrayLike, NDArray

#: Blue, white and red of a symmetric map, safe for colour-blind eyes (the ends of Moreland's cool-warm).
_ENDS = np.array([[59, 76, 192], [242, 242, 242], [180, 4, 38]], float)


def picture(values: ArrayLike, width: int = 240) -> str:
    """A signed array as an ``<img>`` element; zero is white, NaN grey.

    Parameters
    ----------
    values
        ``(rows, columns)``; thinned out where it is larger than the picture.
    width
        Width on the page in pixels.
    """
    image = np.atleast_2d(np.asarray(values, float))
    image = image[:: max(1, image.shape[0] // width), :: max(1, image.shape[1] // width)]
    known = np.isfinite(image)
    top = float(np.percentile(np.abs(image[known]), 99)) if known.any() else 0.0
    share = np.clip(np.where(known, image, 0.0) / (top or 1.0), -1, 1) + 1
    low = np.minimum(share.astype(int), 1)
    colours = _ENDS[low] + (_ENDS[low + 1] - _ENDS[low]) * (share - low)[..., None]
    colours[~known] = 160
    data = base64.b64encode(_png(colours.astype(np.uint8))).decode()
    # A tall matrix is pressed into a square: it is to be seen at one glance.
    height = min(round(width * image.shape[0] / image.shape[1]), width)
    return (
        f'<img src="data:image/png;base64,{data}" width="{width}" height="{height}" '
        'style="image-rendering:pixelated"/>'
    )


def curve(values: ArrayLike, width: int = 240, height: int = 48) -> str:
    """Values in a row as an ``<svg>`` line, its range filling the height."""
    y = np.asarray(values, float).ravel()
    y = y[np.isfinite(y)]
    if y.size < 2:
        return ""
    low, high = float(y.min()), float(y.max())
    x = np.linspace(1, width - 1, y.size)
    at = height - 1 - (height - 2) * (y - low) / ((high - low) or 1.0)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, at, strict=True))
    return (
        f'<svg width="{width}" height="{height}" role="img"><polyline points="{points}" fill="none" '
        'stroke="#0072b2" stroke-width="1.2"/></svg>'
    )


def table(rows: Mapping[str, object] | Sequence[Sequence[object]], title: str = "", beside: str = "") -> str:
    """Rows of plain text as a table, with a heading, beside a picture.

    Parameters
    ----------
    rows
        Names and values, or rows of cells.
    title
        Heading.
    beside
        HTML to the left.
    """
    cells = [(key, value) for key, value in rows.items()] if isinstance(rows, Mapping) else rows
    body = "".join(
        "<tr>" + "".join(f"<td style='text-align:left'>{escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in cells
    )
    head = f"<b>{escape(title)}</b>" if title else ""
    return (
        f"<div style='display:flex;gap:12px;align-items:flex-start'>{beside}"
        f"<div>{head}<table>{body}</table></div></div>"
    )


def _png(pixels: NDArray[np.uint8]) -> bytes:
    """A picture ``(rows, columns, 3)`` as PNG (ISO/IEC 15948)."""
    rows, columns = pixels.shape[:2]
    lines = np.concatenate([np.zeros((rows, 1), np.uint8), pixels.reshape(rows, -1)], axis=1)
    parts = (
        (b"IHDR", struct.pack(">IIBBBBB", columns, rows, 8, 2, 0, 0, 0)),
        (b"IDAT", zlib.compress(lines.tobytes(), 9)),
        (b"IEND", b""),
    )
    chunks = b"".join(
        struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))
        for kind, data in parts
    )
    return b"\x89PNG\r\n\x1a\n" + chunks
