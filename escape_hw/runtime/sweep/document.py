"""A sweep in plain values, as a table of its loops, and judged."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from escape_hw.io.documents import strehl_document
from escape_hw.runtime.criteria import check
from escape_hw.runtime.sweep.plan import EXPLORE, STAGES
from escape_hw.runtime.sweep.result import ArmComparison, SweepResult
from escape_hw.runtime.sweep.run import METRICS


def sweep_document(result: SweepResult) -> dict[str, Any]:
    """What ``result.json`` and ``--json`` tell of a sweep."""
    sweep = result.sweep
    done = {stage: len(result.stage(stage)) for stage in STAGES}
    explored = result.stage(EXPLORE)
    return {
        "sweep": {
            "arms": [{**asdict(arm), "label": arm.label, "path": str(arm.path)} for arm in sweep.arms],
            "parameters": [one.to_text() for one in sweep.space],
            "design": asdict(sweep.design),
            "frames": sweep.frames,
            "metric": sweep.metric,
            "loops": done,
            "diverged": sum(r.merit == 0 for r in result.run.records),
            "margin": result.margin,
            "importance": result.importance,
            "importance_closed": result.importance_closed,
            "curves": {
                arm.label: {
                    "merit": [r.merit for r in explored if r.slot.arm == arm.label],
                    **{
                        one.key: [r.values[one.key] for r in explored if r.slot.arm == arm.label]
                        for one in sweep.space
                    },
                }
                for arm in sweep.arms
            },
        },
        "best": {
            label: {
                "values": best.values,
                "strehl": strehl_document(best.strehl),
                "closed": best.closed,
                "loops": best.airs,
            }
            for label, best in result.best.items()
        },
        "comparisons": _comparisons(result.comparisons),
        "at_random": _comparisons(result.at_random),
        "criteria": [] if result.partial else criteria(result),
        "partial": result.partial,
    }


def _comparisons(found: Sequence[ArmComparison]) -> list[dict[str, Any]]:
    return [
        {"first": one.first, "second": one.second, **asdict(one.found), "text": one.text} for one in found
    ]


def criteria(result: SweepResult) -> list[dict[str, Any]]:
    """Every arm's best loop stays closed; ESCAPE is not below the baseline by more than the margin."""
    checks = [
        check(
            f"{label}: at its best, {best.closed} of {best.airs} loops stayed closed",
            best.closed == best.airs,
        )
        for label, best in result.best.items()
    ]
    sweep = result.sweep
    labels = [arm.label for arm in sweep.arms]
    ours = "ESCAPE + OG" if "ESCAPE + OG" in labels else "ESCAPE"
    for one in result.comparisons:
        if one.first == ours and one.second == labels[0]:
            checks.append(
                check(
                    f"{ours} minus {labels[0]}: at least {100 * one.found.low:+.2f} % Strehl at 95 %, not "
                    f"below −{100 * result.margin:g} %",
                    one.found.low >= -result.margin,
                )
            )
    return checks


def trials_csv(result: SweepResult) -> str:
    """One line per loop: its place in the plan, its parameters, and how it went."""
    keys = [one.key for one in result.sweep.space]
    ratios = [f"strehl_{way}" for way in METRICS]
    errors = [f"{name}_sigma" for name in ratios]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        [
            "stage",
            "matrix",
            "air",
            "candidate",
            *keys,
            *ratios,
            *errors,
            "residual_rms_nm",
            "stable",
            "diverged",
        ]
    )
    for record in result.run.records:
        slot, out = record.slot, record.outcome
        strehl = out.get("strehl") or {}
        table.writerow(
            [
                slot.stage, slot.arm, slot.index, slot.candidate, *(record.values[key] for key in keys),
                *(strehl.get(way, {}).get("value", "") for way in METRICS),
                *(strehl.get(way, {}).get("sigma", "") for way in METRICS),
                out.get("residual_rms_nm", ""), out["stable"], out["diverged"],
            ]
        )  # fmt: skip
    return text.getvalue()
