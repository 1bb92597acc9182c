"""Figures of interaction matrices."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure, FigureBase
from numpy.typing import NDArray

from escape_hw.api.interaction_matrix import InteractionMatrix
from escape_hw.report.figures import style

#: Colour scale of the mode maps, in units of the mode's rms slope.
_LIMIT = 2.5


def representative_modes(n_modes: int, count: int = 8) -> NDArray[np.int_]:
    """Evenly spaced modes, the first and the last among them (paper: IM comparison figure)."""
    return np.unique(np.linspace(0, n_modes - 1, min(count, n_modes)).round().astype(int))


def mode_maps(matrices: Mapping[str, InteractionMatrix], count: int = 8) -> Figure:
    """Slope maps of several matrices side by side (paper: IM comparison figure).

    See :func:`draw_mode_maps`.
    """
    rows = min(count, max(matrix.n_modes for matrix in matrices.values()))
    figure = style.new_figure(1.0 + 2.15 * len(matrices), 0.65 + 1.02 * rows)
    draw_mode_maps(figure, matrices, count)
    return figure


def draw_mode_maps(figure: FigureBase, matrices: Mapping[str, InteractionMatrix], count: int) -> None:
    """Draw slope maps of several matrices side by side into a figure or a part of one.

    One row per representative mode, one column per matrix; each cell holds the x and the y slopes.
    Every mode is divided by its rms, so that all share one scale; a mode that a matrix lacks stays blank.
    """
    n_modes = max(matrix.n_modes for matrix in matrices.values())
    modes = representative_modes(n_modes, count)
    axes = figure.subplots(len(modes), len(matrices), squeeze=False)
    for column, (label, matrix) in enumerate(matrices.items()):
        axes[0, column].set_title(label, color=style.INK, fontsize=10, pad=16, fontweight="bold")
        for part, place in (("x", 0.24), ("y", 0.76)):
            axes[0, column].text(
                place, 1.03, part, transform=axes[0, column].transAxes, ha="center", va="bottom",
                color=style.MUTED, fontsize=8.5, style="italic",
            )  # fmt: skip
        for row, mode in enumerate(modes):
            cell = style.hide_axes(axes[row, column])
            if column == 0:
                cell.set_ylabel(f"mode {mode + 1}", color=style.INK, fontsize=8.5)
            if mode < matrix.n_modes:
                cell.imshow(_mode_colours(matrix, int(mode)), interpolation="nearest")
    style.colour_bar(
        figure, list(axes.ravel()), style.DIVERGING, (-_LIMIT, _LIMIT), "slope / rms slope of the mode",
        extend="both",
    )  # fmt: skip


def _mode_colours(matrix: InteractionMatrix, mode: int) -> NDArray[np.float64]:
    """Colours of one mode's x and y maps with a gap between them."""
    x, y = matrix.maps(mode)
    gap = np.full((x.shape[0], max(1, x.shape[1] // 12)), np.nan)
    both = np.concatenate([x, gap, y], axis=1)
    hidden = np.zeros(both.shape, bool)
    hidden[:, x.shape[1] : x.shape[1] + gap.shape[1]] = True
    power = np.nanmean(np.square(both))
    scale = np.sqrt(power) if power > 0 else 1.0
    return style.map_colours(both / scale, style.DIVERGING, -_LIMIT, _LIMIT, hidden)


def errors_per_mode(matrices: Mapping[str, InteractionMatrix]) -> Figure:
    """Signal-to-noise ratio (above) and standard error (below) of every mode.

    Matrices without stated errors (computed ones) are left out.
    """
    figure = style.new_figure(7.6, 4.6)
    above, below = figure.subplots(2, 1, sharex=True)
    for (label, matrix), colour in zip(matrices.items(), style.SERIES * 2, strict=False):
        if not np.any(matrix.sigma > 0):
            continue
        number = np.arange(1, matrix.n_modes + 1)
        snr = matrix.snr()
        above.semilogy(number, np.where(snr > 0, snr, np.nan), color=colour, label=label, lw=1.4)
        error = np.sqrt(np.mean(np.square(matrix.sigma, dtype=float), axis=0))
        below.semilogy(number, error, color=colour, lw=1.4)
    above.axhline(1.0, color=style.MUTED, lw=0.8, ls=":")
    style.style_axes(above).set_ylabel("signal-to-noise\nratio")
    unit = next(iter(matrices.values())).unit
    style.style_axes(below).set(xlabel="mode", ylabel=f"standard error\n[{unit}]")
    below.set_xlim(left=0.5)
    if above.get_legend_handles_labels()[0]:
        style.legend(above, ncols=4, loc="lower left", bbox_to_anchor=(0, 1.0), borderaxespad=0.2)
    return figure
