"""Whether a sweep has come to its end, and where its result lies."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from escape_hw.io.run_folder import read_result
from escape_hw.report.build import REPORT, write_report
from escape_hw.runtime.sweep.kept import KeptSweep


def finished_document(run: Path, kept: KeptSweep) -> dict[str, Any] | None:
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
    for folder in _folders(run, kept):
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


def _folders(run: Path, kept: KeptSweep) -> Iterator[Path]:
    yield run
    elsewhere = kept.store().finished_in()
    if elsewhere is not None:
        yield Path(elsewhere)
