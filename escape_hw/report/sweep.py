"""Figures, tables and report section of a sweep."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from escape_hw.api.results import Estimate
from escape_hw.report import html, tables
from escape_hw.report.figures import style

#: How parameters are called in figures and tables.
PARAMETER_LABELS = {
    "gain": "gain",
    "leak": "leak",
    "dropped_modes": "dropped modes",
    "delay": "added delay [frames]",
    "optical_gains": "optical gains",
    "matrix": "matrix",
    "chance": "(chance)",
}


def colours(labels: Sequence[str]) -> dict[str, str]:
    """A colour for every variant."""
    return {label: style.SERIES[number % len(style.SERIES)] for number, label in enumerate(labels)}


def strehl_scatter(sweep: Mapping[str, Any]) -> Figure:
    """Strehl ratio of every loop against each parameter, by variant."""
    curves = sweep["curves"]
    keys = [key for key in next(iter(curves.values())) if key != "merit"]
    figure = style.new_figure(2.9 * len(keys) + 0.6, 3.4)
    panels = figure.subplots(1, len(keys), sharey=True, squeeze=False)[0]
    colour_of = colours(list(curves))
    texts = {text.partition("=")[0]: text for text in sweep["parameters"]}
    for axes, key in zip(panels, keys, strict=True):
        dots = [
            (str(value) if isinstance(value, bool | str) else value, 100 * merit, colour_of[label])
            for label, values in curves.items()
            for value, merit in zip(values[key], np.array(values["merit"], float), strict=True)
        ]
        # Shuffled, for the variants ran with the same parameters, and the last drawn would cover the others.
        order = np.random.default_rng(0).permutation(len(dots))
        values_shown, merits, colour = zip(*(dots[k] for k in order), strict=True)
        axes.scatter(values_shown, merits, s=5, lw=0, alpha=0.7, c=colour)
        for label in curves:
            axes.scatter([], [], s=5, lw=0, color=colour_of[label], label=label)
        if texts[key].endswith(":log"):
            axes.set_xscale("log")
        style.style_axes(axes).set_xlabel(PARAMETER_LABELS.get(key, key))
    panels[0].set_ylabel(f"Strehl ratio, {sweep['metric']} [%]")
    style.legend(panels[0], loc="lower left", bbox_to_anchor=(0, 1), ncols=len(curves), markerscale=2.5)
    return figure


def importance(sweep: Mapping[str, Any]) -> Figure:
    """Importance of every parameter, with and without the loops that diverged."""
    found, closed = sweep["importance"], sweep["importance_closed"]
    names = sorted(found, key=lambda name: found[name])
    figure = style.new_figure(6.2, 0.8 + 0.42 * len(names))
    axes = style.style_axes(figure.subplots())
    places = np.arange(len(names))
    for shift, shares, colour, label in (
        (0.2, found, style.SERIES[0], "all loops"),
        (-0.2, closed, style.SERIES[1], "closed loops"),
    ):
        lengths = [100 * shares.get(name, 0) for name in names]
        axes.barh(places + shift, lengths, 0.38, color=colour, label=label)
    axes.set_yticks(places, [PARAMETER_LABELS.get(name, name) for name in names])
    axes.set_xlabel("share of the variance of the Strehl ratio [%]")
    style.legend(axes, loc="lower right")
    return figure


def comparisons(rows: Sequence[Mapping[str, Any]], margin: float) -> Figure:
    """Paired differences with their intervals, and the margin of equivalence."""
    figure = style.new_figure(7.4, 0.9 + 0.42 * len(rows))
    axes = style.style_axes(figure.subplots())
    axes.axvspan(-100 * margin, 100 * margin, color=style.SERIES[2], alpha=0.15, lw=0)
    axes.axvline(0, color=style.MUTED, lw=0.8)
    for place, row in enumerate(reversed(rows)):
        axes.plot([100 * row["low"], 100 * row["high"]], [place, place], color=style.SERIES[0], lw=2)
        axes.plot([100 * row["mean"]], [place], "o", ms=5, color=style.SERIES[0])
    axes.set_yticks(range(len(rows)), [f"{row['first']} minus {row['second']}" for row in reversed(rows)])
    axes.set_xlabel("difference in Strehl ratio [%]")
    axes.set_ylim(-0.6, len(rows) - 0.4)
    return figure


def sweep_section(document: Mapping[str, Any]) -> str:
    """Best of every matrix, comparisons, importances and all loops; nothing without a sweep."""
    sweep = document.get("sweep")
    if not sweep:
        return ""
    loops = sweep["loops"]
    parts = []
    if document["best"]:
        caption = (
            f"Every matrix at its own best parameters: mean over {loops['final'] // len(sweep['curves'])} "
            f"turbulence realisations, the same for all, of {sweep['frames']} frames; with standard errors."
        )
        parts.append(html.table(best_table(document), caption))
    if document["comparisons"]:
        caption = "Paired differences at the best parameters with 95 % intervals. Shaded: equivalence margin."
        drawing = comparisons(document["comparisons"], sweep["margin"])
        parts.append(html.figure("sweepdiff", drawing, caption))
        parts.append(html.note_list([one["text"] for one in document["comparisons"]]))
    if sweep["importance"]:
        caption = (
            "Importance by functional analysis of variance. All loops: one that diverged counts with a "
            "Strehl ratio of 0. Chance: the share of a dummy parameter without effect."
        )
        parts.append(html.figure("sweepimp", importance(sweep), caption))
    if loops["explore"]:
        caption = (
            f"All {loops['explore']} loops with drawn parameters; {sweep['diverged']} of all loops diverged."
        )
        parts.append(html.figure("sweepall", strehl_scatter(sweep), caption))
    if document["at_random"]:
        what = "At the same random parameters, where both loops were stable:"
        parts.append(html.note_list([f"{what} {one['text']}" for one in document["at_random"]]))
    return html.section("Sweep", *parts)


def best_table(document: Mapping[str, Any]) -> tables.Table:
    """Three Strehl ratios and the best parameters of every variant."""
    best = document["best"]
    keys = list(next(iter(best.values()))["values"]) if best else []
    labels = (PARAMETER_LABELS.get(key, key) for key in keys)
    headings = ("Matrix", *tables.STREHL_HEADINGS, *labels, "closed")
    rows = []
    for label, one in best.items():
        ratios = (
            tables.format_percent(_estimate(one["strehl"][way])) for way in ("peak", "otf", "encircled")
        )
        values = (f"{v:.4g}" if isinstance(v, float) else str(v) for v in one["values"].values())
        cells = (ratio.strip(" %") for ratio in ratios)
        rows.append((label, *cells, *values, f"{one['closed']}/{one['loops']}"))
    return tables.Table(headings, tuple(rows))


def _estimate(pair: Mapping[str, float | None]) -> Estimate:
    """A value and its error; JSON has no NaN."""
    value, sigma = pair["value"], pair["sigma"]
    return Estimate(math.nan if value is None else value, math.nan if sigma is None else sigma)


def importance_table(document: Mapping[str, Any]) -> tables.Table:
    """Importance of every parameter in percent."""
    sweep = document["sweep"]
    rows = (
        (
            PARAMETER_LABELS.get(name, name), f"{100 * share:.1f}",
            f"{100 * sweep['importance_closed'].get(name, 0):.1f}",
        )
        for name, share in sweep["importance"].items()
    )  # fmt: skip
    return tables.Table(("Parameter", "importance, all loops [%]", "closed loops [%]"), tuple(rows))
