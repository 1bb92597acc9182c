"""Figures of a sweep, drawn from its document."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from escape_hw.report import style

#: How parameters are called in figures and tables.
NAMES = {
    "gain": "gain",
    "leak": "leak",
    "dropped_modes": "dropped modes",
    "delay": "added delay [frames]",
    "optical_gains": "optical gains",
    "matrix": "matrix",
    "chance": "(chance)",
}


def colours(labels: Sequence[str]) -> dict[str, str]:
    """A colour for every arm."""
    return {label: style.SERIES[number % len(style.SERIES)] for number, label in enumerate(labels)}


def strehl_against(sweep: Mapping[str, Any]) -> Figure:
    """Strehl ratio of every loop against each parameter, by arm."""
    curves = sweep["curves"]
    keys = [key for key in next(iter(curves.values())) if key != "merit"]
    figure = style.new_figure(2.9 * len(keys) + 0.6, 3.4)
    panels = figure.subplots(1, len(keys), sharey=True, squeeze=False)[0]
    tint = colours(list(curves))
    texts = {text.partition("=")[0]: text for text in sweep["parameters"]}
    for axes, key in zip(panels, keys, strict=True):
        dots = [
            (str(value) if isinstance(value, bool | str) else value, 100 * merit, tint[label])
            for label, values in curves.items()
            for value, merit in zip(values[key], np.array(values["merit"], float), strict=True)
        ]
        # Shuffled, for the arms ran at the same parameters and the last drawn would cover the others.
        order = np.random.default_rng(0).permutation(len(dots))
        shown, merits, colour = zip(*(dots[k] for k in order), strict=True)
        axes.scatter(shown, merits, s=5, lw=0, alpha=0.7, c=colour)
        for label in curves:
            axes.scatter([], [], s=5, lw=0, color=tint[label], label=label)
        if texts[key].endswith(":log"):
            axes.set_xscale("log")
        style.tidy(axes).set_xlabel(NAMES.get(key, key))
    panels[0].set_ylabel(f"Strehl ratio, {sweep['metric']} [%]")
    style.legend(panels[0], loc="lower left", bbox_to_anchor=(0, 1), ncols=len(curves), markerscale=2.5)
    return figure


def importance(sweep: Mapping[str, Any]) -> Figure:
    """Importance of every parameter, with and without the loops that diverged."""
    found, closed = sweep["importance"], sweep["importance_closed"]
    names = sorted(found, key=lambda name: found[name])
    figure = style.new_figure(6.2, 0.8 + 0.42 * len(names))
    axes = style.tidy(figure.subplots())
    places = np.arange(len(names))
    for shift, shares, colour, label in (
        (0.2, found, style.SERIES[0], "all loops"),
        (-0.2, closed, style.SERIES[1], "closed loops"),
    ):
        lengths = [100 * shares.get(name, 0) for name in names]
        axes.barh(places + shift, lengths, 0.38, color=colour, label=label)
    axes.set_yticks(places, [NAMES.get(name, name) for name in names])
    axes.set_xlabel("share of the variance of the Strehl ratio [%]")
    style.legend(axes, loc="lower right")
    return figure


def comparisons(rows: Sequence[Mapping[str, Any]], margin: float) -> Figure:
    """Paired differences with their intervals, and the margin that does not matter."""
    figure = style.new_figure(7.4, 0.9 + 0.42 * len(rows))
    axes = style.tidy(figure.subplots())
    axes.axvspan(-100 * margin, 100 * margin, color=style.SERIES[2], alpha=0.15, lw=0)
    axes.axvline(0, color=style.MUTED, lw=0.8)
    for place, row in enumerate(reversed(rows)):
        axes.plot([100 * row["low"], 100 * row["high"]], [place, place], color=style.SERIES[0], lw=2)
        axes.plot([100 * row["mean"]], [place], "o", ms=5, color=style.SERIES[0])
    axes.set_yticks(range(len(rows)), [f"{row['first']} minus {row['second']}" for row in reversed(rows)])
    axes.set_xlabel("difference in Strehl ratio [%]")
    axes.set_ylim(-0.6, len(rows) - 0.4)
    return figure
