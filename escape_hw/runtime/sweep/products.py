"""Products of a sweep: JSON document, table of loops, report; finding the result of a finished sweep."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from escape_hw.io.documents import strehl_document
from escape_hw.io.run_folder import RunFolder, read_result
from escape_hw.report.run_report import REPORT, write_report
from escape_hw.runtime.procedures.criteria import criterion
from escape_hw.runtime.procedures.products import write_run_result
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.runtime.sweep.description import SweepDescription
from escape_hw.runtime.sweep.design import EXPLORE, STAGES
from escape_hw.runtime.sweep.result import SweepResult, VariantComparison
from escape_hw.runtime.sweep.run import METRICS
from escape_hw.runtime.sweep.study import redact_password


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


def _comparisons(found: Sequence[VariantComparison]) -> list[dict[str, Any]]:
    return [
        {"first": one.first, "second": one.second, **asdict(one.found), "text": one.text} for one in found
    ]


def criteria(result: SweepResult) -> list[dict[str, Any]]:
    """Every arm's best loop stays closed; ESCAPE is not below the baseline by more than the margin."""
    checks = [
        criterion(
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
                criterion(
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


TRIALS = "trials.csv"


def save_sweep(
    folder: RunFolder,
    record: BenchRecord,
    description: SweepDescription,
    result: SweepResult,
    wall_seconds: float,
) -> dict[str, Any]:
    """Table of all loops, ``result.json`` and report of a sweep.

    The folder can be resumed from afterwards, too: its description leads to the same study.

    Returns
    -------
    dict
        The run's document; its ``criteria`` say what was met.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    description.save(folder.path)
    folder.add_product("trials", folder.write_text(TRIALS, trials_csv(result)))
    document = {
        **record.header_fields("sweep"),
        "title": f"Matrices compared, each at its best: {record.system}",
        **sweep_document(result),
        "storage": redact_password(description.storage),
        "study": description.study,
        "sampler": description.sampler,
        **record.footer_fields(wall_seconds),
    }
    return write_run_result(folder, document)


def find_finished_result(run: Path, description: SweepDescription) -> dict[str, Any] | None:
    """The result of a sweep that ran to its end, in its own folder or in one that went on with it.

    A report that has gone is built again.

    Parameters
    ----------
    run
        Folder of the sweep that is to be gone on with.
    kept
        What it says of itself.

    Returns
    -------
    dict or None
        Its ``result.json`` with the folder; ``None`` when there is something left to run, or the folder of
        the result is not there any more.

    Raises
    ------
    ProductError
        A result is damaged.
    StorageError
        The study's storage does not answer.
    """
    for folder in _folders(run, description):
        if not (folder / "result.json").is_file():
            continue
        document = read_result(folder)
        if document.get("partial") or "sweep" not in document:
            continue
        if not (folder / REPORT).is_file():
            write_report(folder)
        products = {name: str(path) for name, path in document["products"].items()}
        return {**document, "folder": str(folder.absolute()), "products": products}
    return None


def _folders(run: Path, description: SweepDescription) -> Iterator[Path]:
    yield run
    elsewhere = description.store().finished_in()
    if elsewhere is not None:
        yield Path(elsewhere)
