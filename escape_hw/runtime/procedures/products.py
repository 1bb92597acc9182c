"""Saving of a run: products, ``result.json``, report."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from escape_hw.api.optical_gains import GainsResult
from escape_hw.api.results import CalibrationResult, LoopResult
from escape_hw.io.fits.gains import save_gains
from escape_hw.io.fits.loop import save_loop
from escape_hw.io.fits.matrix import save_matrix
from escape_hw.io.fits.telemetry import LoopTelemetry, save_telemetry
from escape_hw.io.provenance import file_sha256, format_utc
from escape_hw.io.run_folder import RunFolder
from escape_hw.report.run_report import REPORT, write_report
from escape_hw.report.verdict import verdict_document
from escape_hw.runtime.procedures.declaration import SavedRun
from escape_hw.runtime.session.record import BenchRecord


def product_key(label: str) -> str:
    """Name of a product from a label: ``DO-CRIME SHORT`` becomes ``docrime_short``."""
    return re.sub(r"[^a-z0-9]+", "_", label.lower().replace("do-crime", "docrime")).strip("_")


_SAVE: dict[type, Callable[..., Path]] = {
    LoopResult: save_loop, LoopTelemetry: save_telemetry, GainsResult: save_gains
}  # fmt: skip


def add_result(
    folder: RunFolder,
    record: BenchRecord,
    name: str,
    result: CalibrationResult | LoopResult | LoopTelemetry | GainsResult,
    *parents: Path,
) -> Path:
    """Save a result as ``NAME.fits``, with the files it was made from, and list it among the products.

    Raises
    ------
    StorageError
        The file cannot be written.
    """
    path, origin = folder.file(f"{name}.fits"), record.origin({one.name: file_sha256(one) for one in parents})
    # The name of the file of a partial result states it.
    if isinstance(result, CalibrationResult):
        saved = save_matrix(path, result, origin)
    else:
        saved = _SAVE[type(result)](path, result, record.system, record.simulated, origin)
    return folder.add_product(name, saved)


def save_run(
    folder: RunFolder, record: BenchRecord, command: str, title: str, wall_seconds: float, **content: Any
) -> dict[str, Any]:
    """Save a run on a bench as :func:`write_run_result`, with ``content`` between header and footer."""
    return write_run_result(folder, _document(record, command, title, wall_seconds, content))


def save_values(
    folder: RunFolder,
    record: BenchRecord,
    name: str,
    title: str,
    values: Mapping[str, Any],
    wall_seconds: float,
) -> SavedRun:
    """Save a result that consists of a few numbers, by their names, without report."""
    products = {name: str(path) for name, path in folder.products.items()}
    content = {**values, "partial": False, "products": products, "verdict": None}
    document = _document(record, name, title, wall_seconds, content)
    folder.write_result(document)
    return SavedRun({**document, **folder.location_fields()})


def _document(
    record: BenchRecord, command: str, title: str, wall_seconds: float, content: Mapping[str, Any]
) -> dict[str, Any]:
    header = {**record.header_fields(command), "title": title}
    return {**header, **content, "finished_utc": format_utc(), "wall_seconds": wall_seconds}


def write_run_result(folder: RunFolder, document: Mapping[str, Any]) -> dict[str, Any]:
    """Write ``result.json``, build the report, and return the document with the paths of the products.

    An aborted run gets no report, because that takes seconds; ``escape report`` builds it.
    """
    document = {**document, "verdict": verdict_document(document)}
    folder.write_result(document)
    if not document.get("partial"):
        # Named when it is there: the process may end while it is built.
        write_report(folder.path)
        folder.add_product("report", folder.file(REPORT))
        folder.write_result(document)
    products = {name: str(path) for name, path in folder.products.items()}
    return {**document, **folder.location_fields(), "products": products}
