"""Saves a reproduced result, judges it, and builds its report."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from escape_hw.io import documents
from escape_hw.io.run_folder import RunFolder
from escape_hw.runtime import criteria
from escape_hw.runtime.keep import finish, keep_calibration, keep_gains, keep_loop, key_of
from escape_hw.runtime.records import BenchRecord
from escape_hw.runtime.reproduce import Comparison, Table1Result, measured_part
from escape_hw.runtime.reproduce_pywfs import WITH_GAINS


def keep_shwfs(
    folder: RunFolder, record: BenchRecord, result: Comparison, wall_seconds: float
) -> dict[str, Any]:
    """As :func:`keep_comparison`, of :func:`~escape_hw.runtime.reproduce.reproduce_shwfs`."""
    title = f"Calibration without a source: {record.system}"
    return keep_comparison(folder, record, result, wall_seconds, "reproduce shwfs", title)


def keep_pywfs(
    folder: RunFolder, record: BenchRecord, result: Comparison, wall_seconds: float
) -> dict[str, Any]:
    """As :func:`keep_comparison`, of :func:`~escape_hw.runtime.reproduce_pywfs.reproduce_pywfs`."""
    title = f"Calibration and optical gains without a source: {record.system}"
    return keep_comparison(folder, record, result, wall_seconds, "reproduce pywfs", title)


def keep_maps(
    folder: RunFolder, record: BenchRecord, result: Comparison, wall_seconds: float
) -> dict[str, Any]:
    """As :func:`keep_comparison`, of :func:`~escape_hw.runtime.reproduce_maps.reproduce_maps`."""
    title = f"Calibration on the sky, with a dirty mirror: {record.system}"
    return keep_comparison(folder, record, result, wall_seconds, "reproduce maps", title)


def keep_comparison(
    folder: RunFolder,
    record: BenchRecord,
    result: Comparison,
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
        saved[label] = keep_calibration(folder, record, key_of(label), calibration, parents)
    for label, loop in result.loops.items():
        # A matrix scaled by its optical gains comes from the one saved.
        keep_loop(folder, record, f"loop_{key_of(label)}", loop, saved[label.removesuffix(WITH_GAINS)])
    if result.gains is not None:
        beside = {key_of(label): saved[label] for label in result.gains.beside}
        keep_gains(folder, record, "gains", result.gains, {"im": saved["ESCAPE"], **beside})
    escape = result.calibrations.get("ESCAPE")
    estimate = None if escape is None else escape.registration
    checks = [] if result.partial else [criteria.converged("ESCAPE", estimate), *criteria.loops(result.loops)]
    if not result.partial and estimate is not None and record.planted is not None:
        checks.insert(1, criteria.recovered("ESCAPE", estimate, record.planted))
    if not result.partial and result.gains is not None:
        checks.append(criteria.gains_converged(result.gains))
    labels: dict[str, Any] = {key_of(label): {"label": label} for label in result.calibrations}
    labels |= {f"loop_{key_of(label)}": {"label": label} for label in result.loops}
    labels.setdefault("escape", {}).update(measured="DO-CRIME", column="")
    document = {
        **record.head(command),
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
        **record.tail(wall_seconds),
    }
    return finish(folder, document)


def keep_table1(
    folder: RunFolder, record: BenchRecord, result: Table1Result, wall_seconds: float
) -> dict[str, Any]:
    """Products, ``result.json`` and report of :func:`~escape_hw.runtime.reproduce.reproduce_table1`.

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
            source = key_of(f"docrime {column}")
            keep_calibration(folder, record, source, calibration)
            labels[source] = {"label": f"DO-CRIME {column}"}
            continue
        name = key_of(f"escape {column}")
        measured = measured_part(calibration)
        parents = {}
        if measured is not None:
            source = key_of(f"docrime {column}")
            parents = {source: keep_calibration(folder, record, source, measured)}
            labels[source] = {"label": f"DO-CRIME {column}"}
        keep_calibration(folder, record, name, calibration, parents)
        labels[name] = {"label": f"ESCAPE {column}", "measured": f"DO-CRIME {column}", "column": column}
        checks.append(criteria.converged(column, calibration.registration))
        if calibration.registration is not None:
            estimates[column] = calibration.registration
            if record.planted is not None:
                checks.append(criteria.recovered(column, calibration.registration, record.planted))
    if len(estimates) == 2:
        checks += criteria.agree(*estimates.values())
    document = {
        **record.head("reproduce table1"),
        "title": f"Registration from short and long runs: {record.system}",
        "table1": {k: documents.calibration_document(v) for k, v in result.calibrations.items()},
        "criteria": [] if result.partial else checks,
        "labels": labels,
        "partial": result.partial,
        **record.tail(wall_seconds),
    }
    return finish(folder, document)
