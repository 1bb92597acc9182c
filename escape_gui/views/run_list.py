"""Finished runs on disk, one row each. No widgets."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from escape_hw.errors import ProductError
from escape_hw.io.run_folder import RESULT_FILE, find_runs, read_result, run_label, run_time
from escape_hw.report.tables import METHOD_LABELS
from escape_hw.report.verdict import Quality, assess

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
    """The finished runs under a folder, the newest first; a damaged one says so in its verdict."""
    for folder in find_runs(runs):
        if not (folder / RESULT_FILE).is_file():
            continue
        try:
            yield _summarise(folder)
        except (ProductError, OSError) as error:
            yield _damaged(folder, str(error))
        except (TypeError, ValueError, OverflowError) as error:
            yield _damaged(folder, f"its document is damaged ({error})")


def _damaged(folder: Path, why: str) -> RunSummary:
    """A run whose document cannot be read; its files can be opened one by one."""
    return RunSummary(
        folder=folder, date=f"{folder.parent.name} {run_time(folder)}", name=run_label(folder), system="",
        method="damaged", frames=0, quality=None, verdict=f"Damaged: {why}. Load its matrix as a file.",
        size_mb=0.0, matrix=None, simulated=False,
    )  # fmt: skip


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
