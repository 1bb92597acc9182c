"""The part of a report that tells of a sweep."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from escape_hw.api.results import Measured
from escape_hw.report import figures_sweep, html, tables


def sweep_section(document: Mapping[str, Any]) -> str:
    """Best of every matrix, comparisons, importances and all loops; nothing without a sweep."""
    sweep = document.get("sweep")
    if not sweep:
        return ""
    loops = sweep["loops"]
    parts = []
    if document["best"]:
        caption = (
            f"Every matrix at its own best parameters: mean over {loops['final'] // len(sweep['arms'])} "
            f"stretches of air, the same for all, of {sweep['frames']} frames; standard errors over them."
        )
        parts.append(html.table(best_table(document), caption))
    if document["comparisons"]:
        caption = (
            "Paired differences at the best parameters with 95 % intervals. Shaded: what does not matter."
        )
        drawing = figures_sweep.comparisons(document["comparisons"], sweep["margin"])
        parts.append(html.figure("sweepdiff", drawing, caption))
        parts.append(html.notes([one["text"] for one in document["comparisons"]]))
    if sweep["importance"]:
        caption = (
            "Importance by functional analysis of variance. All loops: one that diverged counts with a "
            "Strehl ratio of 0. Chance: what a parameter gets that does nothing."
        )
        parts.append(html.figure("sweepimp", figures_sweep.importance(sweep), caption))
    if loops["explore"]:
        caption = (
            f"All {loops['explore']} loops with drawn parameters; {sweep['diverged']} of all loops diverged."
        )
        parts.append(html.figure("sweepall", figures_sweep.strehl_against(sweep), caption))
    if document["at_random"]:
        what = "At the same random parameters, where both loops were stable:"
        parts.append(html.notes([f"{what} {one['text']}" for one in document["at_random"]]))
    return html.section("Sweep", *parts)


def best_table(document: Mapping[str, Any]) -> tables.Table:
    """Three Strehl ratios and the best parameters of every arm."""
    best = document["best"]
    keys = list(next(iter(best.values()))["values"]) if best else []
    headings = (
        "Matrix", "Strehl, peak [%]", "Strehl, OTF [%]", "Strehl, encircled [%]",
        *(figures_sweep.NAMES.get(key, key) for key in keys), "closed",
    )  # fmt: skip
    rows = []
    for label, one in best.items():
        ratios = (tables.percent(_measured(one["strehl"][way])) for way in ("peak", "otf", "encircled"))
        values = (f"{v:.4g}" if isinstance(v, float) else str(v) for v in one["values"].values())
        cells = (ratio.strip(" %") for ratio in ratios)
        rows.append((label, *cells, *values, f"{one['closed']}/{one['loops']}"))
    return tables.Table(headings, tuple(rows))


def _measured(pair: Mapping[str, float | None]) -> Measured:
    """A value and its error; JSON has no NaN."""
    value, sigma = pair["value"], pair["sigma"]
    return Measured(math.nan if value is None else value, math.nan if sigma is None else sigma)


def importance_table(document: Mapping[str, Any]) -> tables.Table:
    """Importance of every parameter in percent."""
    sweep = document["sweep"]
    rows = (
        (
            figures_sweep.NAMES.get(name, name), f"{100 * share:.1f}",
            f"{100 * sweep['importance_closed'].get(name, 0):.1f}",
        )
        for name, share in sweep["importance"].items()
    )  # fmt: skip
    return tables.Table(("Parameter", "importance, all loops [%]", "closed loops [%]"), tuple(rows))
