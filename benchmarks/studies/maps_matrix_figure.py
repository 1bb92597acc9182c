"""The figure of ``maps_matrix.py``: matrices of 100 modes, their correlation by mode, and maps of some modes."""

from __future__ import annotations

from collections.abc import Mapping

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


def draw(
    matrices: Mapping[str, InteractionMatrix], columns: Mapping[str, NDArray[np.float64]]
) -> Figure:
    """One figure of three parts, from top to bottom."""
    figure = style.new_figure(9.4, 16.2)
    whole, curves, maps = figure.subfigures(3, 1, height_ratios=[4.6, 2.4, 9.2], hspace=0.02)
    draw_whole(whole, matrices)
    draw_correlations(curves, columns)
    draw_mode_maps(maps, matrices, N_DRAWN)
    return figure


def draw_whole(figure: FigureBase, matrices: Mapping[str, InteractionMatrix]) -> None:
    """All slopes (rows) of all modes (columns), each mode relative to its rms."""
    axes = figure.subplots(1, len(matrices), sharey=True)
    for cell, (label, matrix) in zip(axes, matrices.items(), strict=True):
        data = matrix.data / np.sqrt(np.square(matrix.data).mean(axis=0))
        n = matrix.n_slopes // 2
        cell.imshow(
            data, cmap=style.DIVERGING, vmin=-LIMIT, vmax=LIMIT, aspect="auto", interpolation="antialiased",
            extent=(0.5, matrix.n_modes + 0.5, 2 * n, 0),
        )  # fmt: skip
        cell.axhline(n, color=style.INK, lw=0.8)
        style.style_axes(cell, grid=False).set_xlabel("mode")
        cell.set_xticks([1, 20, 40, 60, 80, 100])
        cell.set_title(label, color=style.INK, fontsize=10, fontweight="bold")
    axes[0].set_yticks([n / 2, 3 * n / 2], [f"{n} x slopes", f"{n} y slopes"], rotation=90, va="center")
    style.colour_bar(
        figure, list(axes), style.DIVERGING, (-LIMIT, LIMIT), "slope / rms slope of the mode"
    )


def draw_correlations(figure: FigureBase, columns: Mapping[str, NDArray[np.float64]]) -> None:
    """Correlation by mode."""
    axes = style.style_axes(figure.subplots())
    for (name, label), colour in zip(CURVES.items(), style.SERIES, strict=False):
        values = columns[name]
        axes.plot(np.arange(1, len(values) + 1), values, color=colour, label=label, lw=1.3)
    axes.axhline(0, color=style.MUTED, lw=0.8)
    axes.set(xlabel="mode", ylabel="correlation", xlim=(0.5, len(values) + 0.5), ylim=(-0.2, 1.05))
    style.legend(axes, ncols=3, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)
