"""A page that leads to the reports of several runs."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from escape_hw.io.storage import write_atomic
from escape_hw.report import html

INDEX = "index.html"


def write_index(folder: Path, parts: Mapping[str, Mapping[str, Any]]) -> Path:
    """Write ``index.html``.

    Parameters
    ----------
    folder
        Where to; links are relative to it.
    parts
        Documents of the runs by name, each with its ``criteria`` and its ``products``.

    Returns
    -------
    Path
        The page written.

    Raises
    ------
    StorageError
        It cannot be written.
    """
    folder = folder.absolute()
    body = ["<h1>The paper's tables and figures, reproduced</h1>"]
    body += [_part(folder, name, document) for name, document in parts.items()]
    simulated = any(document.get("simulated") for document in parts.values())
    band = "SIMULATED: every number comes from a digital twin" if simulated else "HARDWARE"
    path = folder / INDEX
    write_atomic(
        path, html.page("Reproduced", [("simulated" if simulated else "hardware", band)], body).encode()
    )
    return path


def _part(folder: Path, name: str, document: Mapping[str, Any]) -> str:
    report = document["products"].get("report")
    link = "" if report is None else html.link(os.path.relpath(report, folder), "report")
    return html.section(
        str(document.get("title") or name), html.checks(document.get("criteria") or []), f"<p>{link}</p>"
    )
