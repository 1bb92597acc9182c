"""Tables and report section of loops on equal turbulence, over several seeds."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from escape_hw.report import html
from escape_hw.report.tables import Table


def paired_section(document: Mapping[str, Any]) -> str:
    """Strehl ratios by seed, and the paired differences; nothing without finished seeds."""
    paired = document.get("paired")
    if not paired or not paired["seeds"]:
        return ""
    caption = (
        "Strehl ratio (peak) in % of the loop with each matrix at its own best gain, on turbulence that the "
        "matrices of a seed share. Each seed is a mirror and turbulence of its own. A matrix without a "
        "stable loop counts with 0. Registration: largest error of ESCAPE's in standard errors. Loops and "
        "matrices below are those of the first seed."
    )
    parts = [html.table(strehl_by_seed_table(paired), caption)]
    if paired["differences"]:
        caption = "Differences of the Strehl ratios in %, paired by seed; two-sided intervals by Student's t."
        parts.append(html.table(differences_table(paired), caption))
    parts.append(html.note_list(paired_notes(paired)))
    return html.section("Paired loops", *parts)


def strehl_by_seed_table(paired: Mapping[str, Any]) -> Table:
    """Strehl ratio of each matrix by seed and their means, with the error of each registration."""
    matrices = paired["matrices"]
    rows = []
    for one in paired["seeds"]:
        cells = [
            f"{100 * one['strehl'][label]:.2f}" if one["stable"][label] else "0 (diverged)"
            for label in matrices
        ]
        pull = one["largest_pull"]
        rows.append((str(one["seed"]), *cells, "–" if pull is None else f"{pull:.1f}"))
    if rows:
        rows.append(("mean", *(f"{100 * paired['mean'][label]:.2f}" for label in matrices), ""))
    return Table(("Seed", *matrices, "registration"), tuple(rows))


def differences_table(paired: Mapping[str, Any]) -> Table:
    """Mean differences with their intervals."""
    rows = tuple(
        (
            f"{one['first']} minus {one['second']}", f"{100 * one['mean']:+.2f}".replace("-", "−"),
            f"{100 * one['low']:+.2f} to {100 * one['high']:+.2f}".replace("-", "−"), str(one["seeds"]),
        )
        for one in paired["differences"]
    )  # fmt: skip
    return Table(("Strehl ratio", "mean [%]", f"{100 * paired['confidence']:.0f} % interval", "seeds"), rows)


def paired_notes(paired: Mapping[str, Any]) -> list[str]:
    """What is missing, by seed."""
    return [f"seed {one['seed']}: {note}" for one in paired["seeds"] for note in one["notes"]]
