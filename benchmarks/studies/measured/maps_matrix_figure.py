"""The figure of ``maps_matrix.py``: maps of all modes, correlation by mode, and larger maps of some modes."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.report.figures import style
from escape_hw.report.figures.matrix import draw_mode_maps

#: Modes whose maps are drawn, and the end of the colour scale in units of the mode's rms slope.
N_DRAWN, LIMIT = 8, 2.5
#: Columns of the comparison that are drawn, and their labels.
CURVES = {
    "correlation twin synthetic": "twin and synthetic",
    "correlation published synthetic": "published and synthetic",
    "correlation published twin": "published and twin",
}


def draw(matrices: Mapping[str, InteractionMatrix], columns: Mapping[str, NDArray[np.float64]]) -> Figure:
    """One figure of three parts, from top to bottom."""
    figure = style.new_figure(8.2, 16.2)
    parts: Any = figure.subfigures(3, 1, height_ratios=[4.75, 1.95, 8.4])
    whole, curves, maps = parts
    draw_all_modes(whole, matrices)
    draw_correlations(curves, columns)
    draw_mode_maps(maps, matrices, N_DRAWN)
    return figure


def draw_all_modes(figure: FigureBase, matrices: Mapping[str, InteractionMatrix]) -> None:
    """The maps of all modes in rows of ten, x slopes above y slopes, each mode relative to its rms."""
    axes = figure.subplots(2, len(matrices))
    for column, (label, matrix) in enumerate(matrices.items()):
        axes[0, column].set_title(label, color=style.INK, fontsize=10, fontweight="bold")
        pair = np.array([matrix.maps(mode) for mode in range(matrix.n_modes)])
        pair /= np.sqrt(np.nanmean(np.square(pair), axis=(1, 2, 3), keepdims=True))
        for cell, maps in zip(axes[:, column], np.moveaxis(pair, 1, 0), strict=True):
            colours = style.map_colours(mosaic(maps), style.DIVERGING, -LIMIT, LIMIT)
            style.hide_axes(cell).imshow(colours, interpolation="nearest")
    for cell, part in zip(axes[:, 0], "xy", strict=True):
        size = cell.get_images()[0].get_size()[0] / 10
        labels = [f"{10 * row + 1}\u2013{10 * row + 10}" for row in range(10)]
        cell.set_yticks((np.arange(10) + 0.5) * size - 0.5, labels)
        cell.tick_params(length=0, labelsize=7, colors=style.INK)
        cell.set_ylabel(f"{part} slopes of modes", color=style.INK, fontsize=8.5)
    limits = (-LIMIT, LIMIT)
    style.colour_bar(figure, list(axes.ravel()), style.DIVERGING, limits, "slope / rms slope of the mode")


def mosaic(maps: NDArray[np.float64]) -> NDArray[np.float64]:
    """Maps ``(n, rows, columns)`` in rows of ten."""
    n, height, width = maps.shape
    return maps.reshape(-1, 10, height, width).swapaxes(1, 2).reshape(n // 10 * height, 10 * width)


def draw_correlations(figure: FigureBase, columns: Mapping[str, NDArray[np.float64]]) -> None:
    """Correlation by mode."""
    axes = style.style_axes(figure.subplots())
    for (name, label), colour in zip(CURVES.items(), style.SERIES, strict=False):
        values = columns[name]
        axes.plot(np.arange(1, len(values) + 1), values, color=colour, label=label, lw=1.3)
    axes.axhline(0, color=style.MUTED, lw=0.8)
    axes.set(xlabel="mode", ylabel="correlation", xlim=(0.5, len(values) + 0.5), ylim=(-0.2, 1.05))
    style.legend(axes, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)
