"""Short text and HTML representations of results for logs and notebooks."""

from __future__ import annotations

import base64
import io
from collections.abc import Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from html import escape
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

#: Longest text, in characters, and longest series, in values, that are shown in full.
_MAX_TEXT, _MAX_ITEMS = 60, 6


def short_repr(one: Any) -> str:
    """A dataclass in one line: short values in full, arrays as type and shape, long values as their length.

    For dataclasses with arrays: ``__repr__ = short_repr``.
    """
    parts = (
        f"{field.name}={describe_value(getattr(one, field.name))}" for field in fields(one) if field.repr
    )
    return f"{type(one).__name__}({', '.join(parts)})"


def describe_value(value: object) -> str:
    """A value as short text."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str):
        return repr(value) if len(value) <= _MAX_TEXT else f"{len(value)} characters"
    if is_dataclass(value) and not isinstance(value, type):
        text = repr(value)
        return text if len(text) <= _MAX_TEXT else f"{type(value).__name__}(...)"
    if isinstance(value, Mapping | Sequence | Set):
        text = repr(value) if len(value) <= _MAX_ITEMS else ""
        return text if 0 < len(text) <= _MAX_TEXT else f"{type(value).__name__} of {len(value)}"
    return repr(value)


#: Blue, white and red of a symmetric colour map (ends of Moreland's cool-warm), colour-blind safe.
_COLOUR_STOPS = np.array([[59, 76, 192], [242, 242, 242], [180, 4, 38]], float)
#: Width of images and lines, and height of lines, pixels.
_WIDTH, _LINE_HEIGHT = 240, 48


def image_html(values: ArrayLike) -> str:
    """A signed array ``(rows, columns)`` as an ``<img>`` element; zero is white, NaN grey.

    It is subsampled if it is larger than the image.
    """
    from matplotlib.image import imsave

    image = np.atleast_2d(np.asarray(values, float))
    image = image[:: max(1, image.shape[0] // _WIDTH), :: max(1, image.shape[1] // _WIDTH)]
    finite = np.isfinite(image)
    top = float(np.percentile(np.abs(image[finite]), 99)) if finite.any() else 0.0
    level = np.clip(np.where(finite, image, 0.0) / (top or 1.0), -1, 1) + 1
    low = np.minimum(level.astype(int), 1)
    colours = _COLOUR_STOPS[low] + (_COLOUR_STOPS[low + 1] - _COLOUR_STOPS[low]) * (level - low)[..., None]
    colours[~finite] = 160
    png = io.BytesIO()
    imsave(png, colours.astype(np.uint8), format="png")
    data = base64.b64encode(png.getvalue()).decode()
    # A tall matrix is compressed to a square to fit on the page.
    height = min(round(_WIDTH * image.shape[0] / image.shape[1]), _WIDTH)
    return (
        f'<img src="data:image/png;base64,{data}" width="{_WIDTH}" height="{height}" '
        'style="image-rendering:pixelated"/>'
    )


def line_html(values: ArrayLike) -> str:
    """A series as an ``<svg>`` line scaled to the height."""
    y = np.asarray(values, float).ravel()
    y = y[np.isfinite(y)]
    if y.size < 2:
        return ""
    low, high = float(y.min()), float(y.max())
    x = np.linspace(1, _WIDTH - 1, y.size)
    at = _LINE_HEIGHT - 1 - (_LINE_HEIGHT - 2) * (y - low) / ((high - low) or 1.0)
    points = " ".join(f"{a:.1f},{b:.1f}" for a, b in zip(x, at, strict=True))
    return (
        f'<svg width="{_WIDTH}" height="{_LINE_HEIGHT}" role="img"><polyline points="{points}" fill="none" '
        'stroke="#0072b2" stroke-width="1.2"/></svg>'
    )


def table_html(
    rows: Mapping[str, object] | Sequence[Sequence[object]], title: str = "", left_html: str = ""
) -> str:
    """Rows of plain text as an HTML table with a heading.

    Parameters
    ----------
    rows
        Names and values, or rows of cells.
    title
        Heading.
    left_html
        HTML to the left of the table.
    """
    cells = [(key, value) for key, value in rows.items()] if isinstance(rows, Mapping) else rows
    body = "".join(
        "<tr>" + "".join(f"<td style='text-align:left'>{escape(str(cell))}</td>" for cell in row) + "</tr>"
        for row in cells
    )
    head = f"<b>{escape(title)}</b>" if title else ""
    return (
        f"<div style='display:flex;gap:12px;align-items:flex-start'>{left_html}"
        f"<div>{head}<table>{body}</table></div></div>"
    )
