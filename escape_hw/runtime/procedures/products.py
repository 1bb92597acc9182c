"""Saving of a run: products, ``result.json``, report."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.results import CalibrationResult, LoopResult
from escape_hw.io.fits.gains import save_gains
from escape_hw.io.fits.loop import save_loop
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.io.fits.telemetry import LoopTelemetry, save_telemetry
from escape_hw.io.provenance import file_sha256
from escape_hw.io.run_folder import RunFolder
from escape_hw.report.run_report import REPORT, write_report
from escape_hw.runtime.procedures.declaration import SavedRun
from escape_hw.runtime.session.record import BenchRecord


def product_key(label: str) -> str:
    """Name of a product from a label: ``DO-CRIME SHORT`` becomes ``docrime_short``."""
    return re.sub(r"[^a-z0-9]+", "_", label.lower().replace("do-crime", "docrime")).strip("_")


def _checksums(parents: Iterable[Path]) -> dict[str, str]:
    return {path.name: file_sha256(path) for path in parents}


def add_calibration(
    folder: RunFolder,
    record: BenchRecord,
    name: str,
    result: CalibrationResult,
    parents: Mapping[str, Path] | None = None,
) -> Path:
    """Save a calibration as ``NAME.fits`` and list it among the products.

    Raises
    ------
    StorageError
        The file cannot be written; as for the other functions of this module.
    """
    origin = record.origin(_checksums((parents or {}).values()))
    return folder.add_product(name, save_matrix(folder.file(f"{name}.fits"), result, origin))


def add_loop(
    folder: RunFolder, record: BenchRecord, name: str, result: LoopResult, matrix: Path | None = None
) -> Path:
    """Save a closed-loop run as ``NAME.fits``, with its control matrix as parent."""
    origin = record.origin(_checksums([] if matrix is None else [matrix]))
    path = folder.file(f"{name}.fits")
    return folder.add_product(name, save_loop(path, result, record.system, record.simulated, origin))


def add_telemetry(
    folder: RunFolder, record: BenchRecord, name: str, telemetry: LoopTelemetry, matrix: Path
) -> Path:
    """Save a loop's telemetry as ``NAME.fits``, with its control matrix as parent."""
    origin, path = record.origin(_checksums([matrix])), folder.file(f"{name}.fits")
    return folder.add_product(name, save_telemetry(path, telemetry, record.system, record.simulated, origin))


def add_gains(
    folder: RunFolder, record: BenchRecord, name: str, result: GainsResult, parents: Mapping[str, Path]
) -> Path:
    """Save optical gains as ``NAME.fits``, with the matrices used as parents."""
    origin, path = record.origin(_checksums(parents.values())), folder.file(f"{name}.fits")
    return folder.add_product(name, save_gains(path, result, record.system, record.simulated, origin))


def write_run_result(folder: RunFolder, document: Mapping[str, Any]) -> dict[str, Any]:
    """Write ``result.json``, build the report, and return the document with the paths of the products.

    An aborted run gets no report, because that takes seconds; ``escape report`` builds it.
    """
    if document.get("partial"):
        folder.write_result(document)
    else:
        folder.add_product("report", folder.file(REPORT))
        folder.write_result(document)
        write_report(folder.path)
    return {
        **document,
        **folder.location_fields(),
        "products": {k: str(v) for k, v in folder.products.items()},
    }


def save_values(
    folder: RunFolder,
    record: BenchRecord,
    name: str,
    title: str,
    values: Mapping[str, Any],
    wall_seconds: float,
) -> SavedRun:
    """Save a result that consists of a few numbers, without products and report.

    Parameters
    ----------
    folder
        The run folder.
    record
        The bench.
    name
        Name of the procedure.
    title
        Heading of the result.
    values
        The numbers, as they appear in ``result.json`` and with ``--json``.
    wall_seconds
        Duration of the run.
    """
    document = {
        **record.header_fields(name),
        "title": title,
        **values,
        "partial": False,
        "products": {},
        **record.footer_fields(wall_seconds),
    }
    folder.write_result(document)
    return SavedRun({**document, **folder.location_fields()})
