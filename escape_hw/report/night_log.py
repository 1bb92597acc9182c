"""A night log as Markdown or as a self-contained HTML page, with figures."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

from matplotlib.figure import Figure

from escape_hw.errors import ConfigError, ProductError
from escape_hw.io.night_log import QUANTITIES, NightEntry, find_nights, read_night, system_of
from escape_hw.io.storage import make_folder, write_atomic
from escape_hw.report import html
from escape_hw.report.figures import style
from escape_hw.report.figures.night import night_figure, nights_figure, summarise
from escape_hw.report.tables import Table

#: Nights in the comparison, this one included.
N_NIGHTS = 14
_CAPTIONS = {
    "night": "Strehl ratio, turbulence, registration and optical gain of the night.",
    "nights": "Median and central 68 % of each night.",
}
_KIND_WORDS = {"note": "note", "event": "", "fault": "FAULT", "alarm": "ALARM"}


def read_nights(runs: Path, system: str, until: str = "") -> dict[str, Sequence[NightEntry]]:
    """Entries of the last :data:`N_NIGHTS` nights of a system by date, up to that of ``until`` if given."""
    paths = [path for path in find_nights(runs, system) if not until or path.parent.name <= until]
    return {path.parent.name: read_night(path) for path in paths[:N_NIGHTS]}


class NightReport:
    """Content of the report of one night.

    Parameters
    ----------
    system
        Name of the system.
    night
        Date of the evening, ``2026-11-22``.
    nights
        Entries of this night and of those before it, by date.
    """

    def __init__(self, system: str, night: str, nights: Mapping[str, Sequence[NightEntry]]) -> None:
        self.system, self.night, self.nights = system, night, nights
        self.entries = nights[night]
        self.simulated = any(entry.simulated for entry in self.entries)

    @classmethod
    def read(cls, runs: Path, system: str = "", night: str = "") -> Self:
        """Read the report of a night; by default the newest one, of the system that was used last.

        Raises
        ------
        ProductError
            There is no such night log, or it cannot be read.
        """
        paths = [path for path in find_nights(runs, system or "*") if not night or path.parent.name == night]
        if not paths:
            known = ", ".join(dict.fromkeys(path.parent.name for path in find_nights(runs))) or "none"
            what = " ".join(filter(None, (system, night))) or "any system"
            raise ProductError(f"{runs}: no night log of {what}; there are: {known}")
        newest = max(paths, key=lambda path: (path.parent.name, path.stat().st_mtime))
        system, night = system_of(newest), newest.parent.name
        return cls(system, night, read_nights(runs, system, night))

    @property
    def title(self) -> str:
        """Night and system."""
        return f"Night of {self.night}, {self.system}"

    @property
    def lines(self) -> list[tuple[str, str]]:
        """Local time and text of all entries but samples."""
        return [
            (f"{entry.time.astimezone():%H:%M:%S}", describe_entry(entry))
            for entry in self.entries
            if entry.kind != "sample"
        ]

    def summary(self) -> dict[str, str]:
        """Median and central 68 % of every quantity, in words."""
        rows = {}
        for name, (median, low, high) in summarise(self.entries).items():
            label, unit = QUANTITIES[name]
            scale = 100.0 if name == "r0_m" else 1.0
            unit = "cm" if name == "r0_m" else unit
            rows[label] = f"{_format_range(scale * median, scale * low, scale * high)} {unit}".rstrip()
        return rows

    def figures(self) -> dict[str, Figure]:
        """The figures that have data, by name."""
        drawn = {"night": night_figure(self.entries), "nights": nights_figure(self.nights)}
        return {name: figure for name, figure in drawn.items() if figure is not None}

    def to_markdown(self, images: Mapping[str, str]) -> str:
        """Markdown; ``images``: link by name of the figure."""
        parts = [f"# {self.title}", ""]
        if self.simulated:
            parts += ["**SIMULATED**", ""]
        if rows := self.summary():
            parts += ["| quantity | median (central 68 %) |", "|---|---|"]
            parts += [f"| {name} | {value} |" for name, value in rows.items()] + [""]
        for name, link in images.items():
            parts += [f"![{_CAPTIONS[name]}]({link})", ""]
        parts += ["## Log", ""]
        parts += [f"- {time} {' '.join(text.split())}" for time, text in self.lines]
        return "\n".join(parts) + "\n"

    def to_html(self) -> str:
        """A self-contained page."""
        figures = {name: html.figure(name, one, _CAPTIONS[name]) for name, one in self.figures().items()}
        table = Table(("Local time", "Entry"), tuple(self.lines), numeric=False)
        return html.page(
            self.title,
            [("simulated", "SIMULATED")] if self.simulated else [],
            [
                f"<h1>{html.escape(self.title)}</h1>",
                html.key_values(self.summary()),
                html.section("Night", figures.get("night", "")),
                html.section("Nights", figures.get("nights", "")),
                html.section("Log", html.table(table)),
            ],
        )

    def write(self, target: Path) -> tuple[Path, ...]:
        """Write the report into a file, ``.html``, or ``.md`` with PNG figures beside it; returns the files.

        Raises
        ------
        ConfigError
            The file has another suffix.
        StorageError
            A file cannot be written.
        """
        make_folder(target.absolute().parent)
        if target.suffix == ".html":
            write_atomic(target, self.to_html().encode())
            return (target,)
        if target.suffix != ".md":
            raise ConfigError(f"{target}: a night log is written as .md or .html")
        images = {name: target.with_name(f"{target.stem}_{name}.png") for name in self.figures()}
        for name, figure in self.figures().items():
            write_atomic(images[name], style.png(figure))
        links = {name: path.name.replace(" ", "%20") for name, path in images.items()}
        write_atomic(target, self.to_markdown(links).encode())
        return (target, *images.values())


def _format_range(median: float, low: float, high: float) -> str:
    """A median, and the range of the values with two digits of its half width if they differ."""
    half = (high - low) / 2
    if half <= 1e-9 * abs(median):
        return f"{median:.4g}"
    digits = min(6, max(0, 1 - math.floor(math.log10(half))))
    return f"{median:.{digits}f} ({low:.{digits}f} to {high:.{digits}f})"


def describe_entry(entry: NightEntry) -> str:
    """An entry other than a sample in words."""
    kind = _KIND_WORDS.get(entry.kind, "")
    author = entry.author if entry.kind == "note" else ""
    head = ", ".join(filter(None, (kind, author)))
    text = entry.text.removeprefix("FAULT: ") if entry.kind == "fault" else entry.text
    return f"{head}: {text}" if head else text
