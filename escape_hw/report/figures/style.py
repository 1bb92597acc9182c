"""Common style of all figures; SVG that follows the page's light or dark colours."""

from __future__ import annotations

import io
import re
from collections.abc import Sequence
from typing import Any

import matplotlib
import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.cm import ScalarMappable
from matplotlib.collections import PatchCollection
from matplotlib.colors import Colormap, PowerNorm
from matplotlib.figure import Figure, FigureBase
from matplotlib.patches import Circle
from numpy.typing import NDArray

# Figures are made without pyplot: no global state, no windows, safe in any thread.

INK, MUTED, LINE = "#1d2733", "#66727f", "#cfd6dd"
#: Distinguishable with any colour vision, on white and on near-black (after Tol and Okabe-Ito).
SERIES = ("#2f7fc1", "#e07b1a", "#1b9e77", "#b565a7", "#b59a1d", "#c8505a")
#: Diverging, perceptually even, safe for colour-blind eyes.
DIVERGING = "RdBu_r"
_VARIABLES = {INK: "var(--ink)", MUTED: "var(--muted)", LINE: "var(--line)"}
_NAN_COLOUR = (0.5, 0.55, 0.6, 0.14)


def new_figure(width: float, height: float) -> Figure:
    """An empty figure of that size in inches, transparent, laid out without overlaps."""
    figure = Figure(figsize=(width, height), facecolor="none", layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def colormap(name: str) -> Colormap:
    """A colour map of Matplotlib by name."""
    return matplotlib.colormaps[name]


def style_axes(axes: Axes, *, grid: bool = True) -> Axes:
    """Apply the common style to axes with scales."""
    axes.set_facecolor("none")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    for side in ("left", "bottom"):
        axes.spines[side].set_color(MUTED)
        axes.spines[side].set_linewidth(0.7)
    axes.tick_params(colors=INK, labelsize=8, width=0.7, length=3, which="both")
    axes.xaxis.label.set(color=INK, fontsize=8.5)
    axes.yaxis.label.set(color=INK, fontsize=8.5)
    axes.title.set(color=INK, fontsize=9.5)
    if grid:
        axes.grid(True, color=LINE, linewidth=0.6)
        axes.set_axisbelow(True)
    return axes


def hide_axes(axes: Axes) -> Axes:
    """Axes that hold a picture: no frame, no ticks."""
    axes.set_facecolor("none")
    axes.set_xticks([])
    axes.set_yticks([])
    for spine in axes.spines.values():
        spine.set_visible(False)
    return axes


def legend(axes: Axes, **options: Any) -> None:
    """A legend without a box."""
    drawn_legend = axes.legend(frameon=False, fontsize=8, **options)
    for text in drawn_legend.get_texts():
        text.set_color(INK)


def map_colours(
    values: NDArray[np.float64], name: str, low: float, high: float, hidden: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Colours ``(rows, columns, 4)`` of a map; NaN becomes a neutral veil, ``hidden`` transparent."""
    scaled = np.clip((np.nan_to_num(values) - low) / (high - low), 0, 1)
    rgba = np.asarray(colormap(name)(scaled), dtype=float)
    rgba[~np.isfinite(values)] = _NAN_COLOUR
    if hidden is not None:
        rgba[hidden] = 0
    return rgba


def discs(
    places: NDArray[np.float64], colours: NDArray[np.float64], border: NDArray[np.float64] | float = 0.0
) -> tuple[PatchCollection, float]:
    """Discs at places ``(n, 2)`` in colours ``(n, 4)``, and their radius: half the distance of neighbours."""
    distance = np.hypot(*(places[:, None, k] - places[:, k] for k in (0, 1)))
    np.fill_diagonal(distance, np.inf)
    radius = 0.5 * float(np.median(distance.min(axis=1))) if len(places) > 1 else 0.5
    drawn = PatchCollection([Circle((x, y), radius) for x, y in places], linewidths=border)
    drawn.set_facecolor([tuple(c) for c in colours])
    return drawn, radius


def colour_bar(
    figure: FigureBase,
    axes: Sequence[Axes],
    name: str,
    limits: tuple[float, float],
    label: str,
    shrink: float = 1.0,
    extend: str = "neither",
    power: float = 1.0,
) -> None:
    """A slim colour bar next to its axes.

    ``extend`` names the ends beyond which values are drawn, too; colours follow this ``power`` of the values.
    """
    bar = figure.colorbar(
        ScalarMappable(PowerNorm(power, *limits), colormap(name)),
        ax=list(axes),
        fraction=0.025,
        pad=0.015,
        aspect=35 * shrink,
        shrink=shrink,
        extend=extend,
    )
    bar.outline.set_visible(False)
    bar.ax.tick_params(colors=INK, labelsize=8, width=0.7, length=3)
    bar.set_label(label, color=INK, fontsize=8.5)


def png(figure: Figure, dpi: int = 150) -> bytes:
    """The figure on white as PNG."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", dpi=dpi, facecolor="white")
    return buffer.getvalue()


def svg(figure: Figure, key: str) -> str:
    """The figure as an SVG element for an HTML page.

    Its neutral colours become the page's CSS variables, and its ids carry ``key`` so that several
    figures can share a page.
    """
    buffer = io.StringIO()
    # A fixed salt and no date: the same figures give the same report, byte for byte.
    with matplotlib.rc_context({"svg.hashsalt": "escape", "svg.image_inline": True}):
        figure.savefig(buffer, format="svg", metadata={"Date": None, "Creator": None}, dpi=150)
    text = buffer.getvalue()
    text = text[text.index("<svg") :]
    text = re.sub(r"<metadata>.*?</metadata>", "", text, flags=re.DOTALL)
    text = re.sub(r'\bid="', f'id="{key}-', text)
    text = re.sub(r'(url\(|href=")#', rf"\1#{key}-", text)
    for colour, variable in _VARIABLES.items():
        text = text.replace(colour, variable)
    # The page sets the width; the view box keeps the proportions.
    return re.sub(r'(<svg[^>]*?) width="[^"]*"| height="[^"]*pt"', r"\1", text, count=2)
