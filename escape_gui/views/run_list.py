"""Finished runs on disk, one row each. No widgets."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from escape_hw.errors import ProductError
from escape_hw.io.run_folder import find_runs, read_result, run_label, run_time
from escape_hw.report.tables import METHOD_LABELS
from escape_hw.report.verdict import Quality, assess

log = logging.getLogger(__name__)
#: Products with a matrix, in the order of preference; ``im`` is the one to close the loop with.
_MATRICES = ("im", "escape", "docrime")
COLUMNS = ("Date", "Run", "System", "Method", "Frames", "Quality", "Size")


@dataclass(frozen=True, slots=True)
class RunSummary:
    """A finished run."""

    folder: Path
    #: Start, ``2026-11-22 21:45:30``.
    date: str
    #: Name of the run, also of its matrix in the loop.
    name: str
    system: str
    method: str
    frames: int
    quality: Quality | None
    verdict: str
    size_mb: float
    #: Matrix to close the loop with; ``None`` if the run has none.
    matrix: Path | None
    simulated: bool

    @property
    def cells(self) -> list[tuple[str, float | str]]:
        """Text and value for sorting of each of :data:`COLUMNS`."""
        system = f"{self.system} (simulated)" if self.simulated else self.system
        quality = ("", -1) if self.quality is None else (self.quality.text, self.quality)
        return [
            (self.date, self.date), (self.name, self.name), (system, self.system), (self.method, self.method),
            (f"{self.frames:,}" if self.frames else "", self.frames), quality,
            (f"{self.size_mb:.1f} MB", self.size_mb),
        ]  # fmt: skip


def read_runs(runs: Path) -> Iterator[RunSummary]:
    """The finished runs under a folder, the newest first; a damaged one is left out, and logged."""
    for folder in find_runs(runs):
        try:
            yield _summarise(folder)
        except (ProductError, OSError) as error:
            log.info("run not listed: %s", error)
        except (TypeError, ValueError, OverflowError) as error:
            log.info("run not listed: %s: its document is damaged (%s)", folder, error)


def _summarise(folder: Path) -> RunSummary:
    document = read_result(folder)
    verdict = assess(document)
    products = document["products"]
    method = str(document.get("method") or document.get("command") or "")
    return RunSummary(
        folder=folder,
        date=f"{folder.parent.name} {run_time(folder)}",
        name=run_label(folder),
        system=str(document.get("system", "")),
        method=METHOD_LABELS.get(method, method),
        frames=int(document.get("frames") or 0),
        quality=None if verdict is None else verdict.quality,
        verdict="" if verdict is None else str(verdict),
        size_mb=sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 1e6,
        matrix=next((products[key] for key in _MATRICES if key in products), None),
        simulated=bool(document.get("simulated")),
    )
