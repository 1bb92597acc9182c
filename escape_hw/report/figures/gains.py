"""Figures of the optical gains."""

from __future__ import annotations

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from escape_hw.api.optical_gains import GainsResult, OpticalGains
from escape_hw.report.figures import style
from escape_hw.report.tables import METHOD_LABELS


def optical_gains(result: GainsResult) -> Figure:
    """Gain of every mode with its standard error, and the trend (paper: optical gain vectors).

    Matrices whose gains lie below 1 (measured on a calmer beam than the loop's) are read on the left,
    those above 1 (measured in open loop) on the right, as in the paper.
    """
    vectors = {METHOD_LABELS.get(result.method, result.method): result.gains, **result.comparisons}
    known = {label: gains for label, gains in vectors.items() if gains is not None}
    figure = style.new_figure(7.8, 4.0)
    left = figure.subplots()
    style.style_axes(left).set(xlabel="mode", ylabel="optical gain")
    below = [label for label, gains in known.items() if np.median(gains.best) <= 1]
    right = left.twinx() if 0 < len(below) < len(known) else left
    if right is not left:
        style.style_axes(right, grid=False).set_ylabel("optical gain of open-loop matrices")
        right.spines["right"].set_visible(True)
        right.spines["right"].set_color(style.MUTED)
        left.set_ylabel("optical gain")
    handles = []
    for (label, gains), colour in zip(known.items(), style.SERIES, strict=False):
        axes = left if label in below or right is left else right
        side = "" if right is left else (" (left)" if axes is left else " (right)")
        handles.append(_draw_gains(axes, gains, label + side, colour))
    left.xaxis.set_major_locator(MaxNLocator(integer=True))
    # Above the drawing: within it there is a curve everywhere.
    style.legend(left, handles=handles, loc="lower left", bbox_to_anchor=(0, 1), ncols=len(handles))
    return figure


def _draw_gains(axes: Axes, gains: OpticalGains, label: str, colour: str) -> object:
    modes = np.arange(1, gains.n_modes + 1)
    shown = np.isfinite(gains.sigma)
    axes.errorbar(
        modes[shown], gains.value[shown], gains.sigma[shown], fmt="o", ms=2.5, lw=0.7, color=colour, alpha=0.6
    )
    low, high = gains.trend - gains.trend_sigma, gains.trend + gains.trend_sigma
    axes.fill_between(modes, low, high, color=colour, alpha=0.2, lw=0)
    return axes.plot(modes, gains.trend, "-", color=colour, lw=1.6, label=label)[0]


def bootstrap(result: GainsResult) -> Figure:
    """Effective gain and residual of each closure and round, and the change of the gains."""
    figure = style.new_figure(7.8, 4.6)
    top, bottom = figure.subplots(2, 1)
    steps = result.closure
    number = np.arange(1, len(steps) + 1)
    effective = [step.gain * step.optical_gain for step in steps]
    top.plot(number, effective, "o-", ms=3, color=style.SERIES[0], label="effective gain")
    top.axhline(result.loop_gain, color=style.MUTED, lw=1.0, ls=":", label="target")
    top.xaxis.set_major_locator(MaxNLocator(integer=True))
    style.style_axes(top).set(xlabel="number of the gain tried", ylabel="effective gain")
    residual = top.twinx()
    line = residual.plot(
        number, [step.residual_nm for step in steps], "s--", ms=3, lw=1.0, color=style.SERIES[1],
        label="residual",
    )  # fmt: skip
    style.style_axes(residual, grid=False).set_ylabel("residual [nm]")
    style.legend(top, handles=[*top.lines, *line])
    rounds = np.arange(1, len(result.rounds) + 1)
    bottom.plot(
        rounds, [100 * one.change for one in result.rounds], "o-", ms=3, color=style.SERIES[2], label="change"
    )
    bottom.plot(
        rounds, [100 * one.expected_change for one in result.rounds], "--", lw=1.0, color=style.INK,
        label="expected of the errors",
    )  # fmt: skip
    bottom.set_xticks(rounds, [f"{100 * one.poke:.2g} %" for one in result.rounds])
    style.style_axes(bottom).set(
        xlabel="poke of the round, share of the stroke", ylabel="change of gains [%]"
    )
    style.legend(bottom)
    return figure
