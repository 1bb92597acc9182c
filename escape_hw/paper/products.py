"""Saves a reproduced result, judges it, and builds its report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from escape_hw.io import documents
from escape_hw.io.run_folder import RunFolder
from escape_hw.paper.experiments import WITH_GAINS, CalibrationComparison, Table1Result
from escape_hw.runtime.procedures import criteria
from escape_hw.runtime.procedures.calibration import measured_calibration
from escape_hw.runtime.procedures.products import (
    add_calibration,
    add_gains,
    add_loop,
    product_key,
    write_run_result,
)
from escape_hw.runtime.session.record import BenchRecord


def save_shwfs(
    folder: RunFolder, record: BenchRecord, result: CalibrationComparison, wall_seconds: float
) -> dict[str, Any]:
    """As :func:`save_comparison`, of :func:`~escape_hw.paper.experiments.reproduce_shwfs`."""
    title = f"Calibration without a source: {record.system}"
    return save_comparison(folder, record, result, wall_seconds, "reproduce shwfs", title)


def save_pywfs(
    folder: RunFolder, record: BenchRecord, result: CalibrationComparison, wall_seconds: float
) -> dict[str, Any]:
    """As :func:`save_comparison`, of :func:`~escape_hw.paper.experiments.reproduce_pywfs`."""
    title = f"Calibration and optical gains without a source: {record.system}"
    return save_comparison(folder, record, result, wall_seconds, "reproduce pywfs", title)


def save_maps(
    folder: RunFolder, record: BenchRecord, result: CalibrationComparison, wall_seconds: float
) -> dict[str, Any]:
    """As :func:`save_comparison`, of :func:`~escape_hw.paper.experiments.reproduce_maps`."""
    title = f"Calibration on the sky, with a dirty mirror: {record.system}"
    return save_comparison(folder, record, result, wall_seconds, "reproduce maps", title)


def save_comparison(
    folder: RunFolder,
    record: BenchRecord,
    result: CalibrationComparison,
    wall_seconds: float,
    command: str,
    title: str,
) -> dict[str, Any]:
    """Products, ``result.json`` and report of several calibrations of one system.

    Returns
    -------
    dict
        The run's document; its ``criteria`` say what was met.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    saved: dict[str, Path] = {}
    for label, calibration in result.calibrations.items():
        parents = {"docrime": saved["DO-CRIME"]} if label == "ESCAPE" and "DO-CRIME" in saved else {}
        saved[label] = add_calibration(folder, record, product_key(label), calibration, parents)
    for label, loop in result.loops.items():
        # A matrix scaled by its optical gains comes from the one saved.
        add_loop(folder, record, f"loop_{product_key(label)}", loop, saved[label.removesuffix(WITH_GAINS)])
    if result.gains is not None:
        beside = {product_key(label): saved[label] for label in result.gains.comparisons}
        add_gains(folder, record, "gains", result.gains, {"im": saved["ESCAPE"], **beside})
    escape = result.calibrations.get("ESCAPE")
    estimate = None if escape is None else escape.registration
    checks = (
        []
        if result.partial
        else [criteria.sprint_converged("ESCAPE", estimate), *criteria.loop_criteria(result.loops)]
    )
    if not result.partial and estimate is not None and record.planted is not None:
        checks.insert(1, criteria.injected_value_recovered("ESCAPE", estimate, record.planted))
    if not result.partial and result.gains is not None:
        checks.append(criteria.gains_converged(result.gains))
    labels: dict[str, Any] = {product_key(label): {"label": label} for label in result.calibrations}
    labels |= {f"loop_{product_key(label)}": {"label": label} for label in result.loops}
    labels.setdefault("escape", {}).update(measured="DO-CRIME", column="")
    document = {
        **record.header_fields(command),
        "title": title,
        "calibrations": {k: documents.calibration_document(v) for k, v in result.calibrations.items()},
        **documents.registration_document(estimate),
        "loops": {label: documents.loop_document(loop) for label, loop in result.loops.items()},
        "scans": {k: [documents.loop_document(run) for run in runs] for k, runs in result.scans.items()},
        "criteria": checks,
        "labels": labels,
        "partial": result.partial,
        "notes": list(result.notes),
        **({"sky_time": result.sky_time} if result.sky_time else {}),
        **record.footer_fields(wall_seconds),
    }
    return write_run_result(folder, document)


def save_table1(
    folder: RunFolder, record: BenchRecord, result: Table1Result, wall_seconds: float
) -> dict[str, Any]:
    """Products, ``result.json`` and report of :func:`~escape_hw.paper.experiments.reproduce_table1`.

    Returns
    -------
    dict
        The run's document; its ``criteria`` say what was met.

    Raises
    ------
    StorageError
        Something cannot be written.
    """
    labels, checks = {}, []
    estimates = {}
    for column, calibration in result.calibrations.items():
        if calibration.registration is None:
            # Stopped before SPRINT: what there is is a DO-CRIME matrix.
            source = product_key(f"docrime {column}")
            add_calibration(folder, record, source, calibration)
            labels[source] = {"label": f"DO-CRIME {column}"}
            continue
        name = product_key(f"escape {column}")
        measured = measured_calibration(calibration)
        parents = {}
        if measured is not None:
            source = product_key(f"docrime {column}")
            parents = {source: add_calibration(folder, record, source, measured)}
            labels[source] = {"label": f"DO-CRIME {column}"}
        add_calibration(folder, record, name, calibration, parents)
        labels[name] = {"label": f"ESCAPE {column}", "measured": f"DO-CRIME {column}", "column": column}
        checks.append(criteria.sprint_converged(column, calibration.registration))
        if calibration.registration is not None:
            estimates[column] = calibration.registration
            if record.planted is not None:
                checks.append(
                    criteria.injected_value_recovered(column, calibration.registration, record.planted)
                )
    if len(estimates) == 2:
        checks += criteria.short_and_long_agree(*estimates.values())
    document = {
        **record.header_fields("reproduce table1"),
        "title": f"Registration from short and long runs: {record.system}",
        "table1": {k: documents.calibration_document(v) for k, v in result.calibrations.items()},
        "criteria": [] if result.partial else checks,
        "labels": labels,
        "partial": result.partial,
        **record.footer_fields(wall_seconds),
    }
    return write_run_result(folder, document)
