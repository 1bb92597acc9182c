"""Products of a sweep: JSON document, table of loops, report; the result of a finished sweep."""

from __future__ import annotations

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from escape_hw.io.documents import strehl_document
from escape_hw.io.run_folder import RunFolder, read_result
from escape_hw.report.run_report import REPORT, write_report
from escape_hw.runtime.procedures.criteria import criterion
from escape_hw.runtime.procedures.products import save_run
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.sweep.description import SweepDescription
from escape_hw.runtime.sweep.design import EXPLORE, METRICS, STAGES
from escape_hw.runtime.sweep.result import SweepResult, VariantComparison
from escape_hw.runtime.sweep.study import redact_password

#: File name of the table of loops.
TRIALS = "trials.csv"


def sweep_document(result: SweepResult) -> dict[str, Any]:
    """The part of ``result.json`` and ``--json`` that describes the sweep."""
    sweep = result.sweep
    curves: dict[str, dict[str, list[Any]]] = {}
    for one in sweep.variants:
        loops = result.stage(EXPLORE, one.label)
        values = {p.key: [r.values[p.key] for r in loops] for p in sweep.space}
        curves[one.label] = {"merit": [r.merit for r in loops], **values}
    return {
        "sweep": {
            "variants": [
                {**asdict(one), "label": one.label, "path": str(one.path)} for one in sweep.variants
            ],
            "parameters": [one.to_text() for one in sweep.space],
            "design": asdict(sweep.design),
            "frames": sweep.frames,
            "metric": sweep.metric,
            "loops": {stage: len(result.stage(stage)) for stage in STAGES},
            "diverged": sum(r.merit == 0 for r in result.run.records),
            "margin": result.margin,
            "importance": result.importance,
            "importance_closed": result.importance_closed,
            "curves": curves,
        },
        "best": {
            label: {**asdict(best), "strehl": strehl_document(best.strehl)}
            for label, best in result.best.items()
        },
        "comparisons": _comparison_rows(result.comparisons),
        "at_random": _comparison_rows(result.at_random),
        "criteria": [] if result.partial else criteria(result),
        "partial": result.partial,
    }


def _comparison_rows(found: Sequence[VariantComparison]) -> list[dict[str, Any]]:
    return [
        {"first": one.first, "second": one.second, **asdict(one.found), "text": one.text} for one in found
    ]


def criteria(result: SweepResult) -> list[dict[str, Any]]:
    """Every variant's best loops stay closed; ESCAPE is not below the baseline by more than the margin."""
    checks = [
        criterion(
            f"{label}: at its best, {best.closed} of {best.loops} loops stayed closed",
            best.closed == best.loops,
        )
        for label, best in result.best.items()
    ]
    labels = [one.label for one in result.sweep.variants]
    ours = "ESCAPE + OG" if "ESCAPE + OG" in labels else "ESCAPE"
    for one in result.comparisons:
        if (one.first, one.second) == (ours, labels[0]):
            checks.append(
                criterion(
                    f"{ours} minus {labels[0]}: at least {100 * one.found.low:+.2f} % Strehl at 95 %, not "
                    f"below −{100 * result.margin:g} %",
                    one.found.low >= -result.margin,
                )
            )
    return checks


def trials_csv(result: SweepResult) -> str:
    """Table with one line for each loop: its slot, its parameters, and its outcome."""
    keys = [one.key for one in result.sweep.space]
    text = io.StringIO()
    table = csv.writer(text, lineterminator="\n")
    table.writerow(
        [
            "stage", "matrix", "realisation", "candidate", *keys, *(f"strehl_{name}" for name in METRICS),
            *(f"strehl_{name}_sigma" for name in METRICS), "residual_rms_nm", "stable", "diverged",
        ]
    )  # fmt: skip
    for record in result.run.records:
        slot, out = record.slot, record.outcome
        strehl = out.get("strehl") or {}
        table.writerow(
            [
                slot.stage, slot.variant, slot.index, slot.candidate, *(record.values[key] for key in keys),
                *(strehl.get(name, {}).get("value", "") for name in METRICS),
                *(strehl.get(name, {}).get("sigma", "") for name in METRICS),
                out.get("residual_rms_nm", ""), out["stable"], out["diverged"],
            ]
        )  # fmt: skip
    return text.getvalue()


def save_sweep(
    folder: RunFolder,
    record: BenchRecord,
    description: SweepDescription,
    result: SweepResult,
    wall_seconds: float,
) -> dict[str, Any]:
    """Save description, table of loops, ``result.json`` and report of a sweep; returns the document.

    The sweep can also be resumed from this folder: its description names the same study.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    description.save(folder.path)
    folder.add_product("trials", folder.write_text(TRIALS, trials_csv(result)))
    return save_run(
        folder, record, "sweep", f"Matrices compared, each at its best: {record.system}", wall_seconds,
        **sweep_document(result), storage=redact_password(description.storage), study=description.study,
        sampler=description.sampler,
    )  # fmt: skip


def find_finished_result(run: Path, description: SweepDescription) -> dict[str, Any] | None:
    """The result of a finished sweep with its folder, which may be the one it was resumed in.

    ``None`` when loops are left to run, or the folder of the result was removed. A missing report is built
    again.

    Raises
    ------
    ProductError
        A result is damaged.
    StorageError
        The study's storage does not answer.
    """
    folder = run
    if not _is_finished(run):
        with description.open_study() as study:
            folder = Path(study.result_folder() or run)
    if not _is_finished(folder):
        return None
    document = read_result(folder)
    if not (folder / REPORT).is_file():
        write_report(folder)
    products = {name: str(path) for name, path in document["products"].items()}
    return {**document, "folder": str(folder.absolute()), "products": products}


def _is_finished(folder: Path) -> bool:
    if not (folder / "result.json").is_file():
        return False
    document = read_result(folder)
    return "sweep" in document and not document.get("partial")
