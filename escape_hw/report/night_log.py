"""A night log as Markdown or as a self-contained HTML page, with figures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

from matplotlib.figure import Figure

from escape_hw.errors import ConfigError, ProductError
from escape_hw.io.night_log import QUANTITIES, NightEntry, find_nights, read_night, system_of
from escape_hw.io.storage import make_folder, write_atomic
from escape_hw.pipeline.seeing import seeing_arcsec
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


class NightReport:
    """Content of the report of one night.

    Parameters
    ----------
    runs
        Parent of the run folders.
    system
        Name of the system; by default that of the newest night log.
    night
        Date of the evening, ``2026-11-22``; by default the newest one.

    Raises
    ------
    ProductError
        There is no such night log, or it cannot be read.
    """

    def __init__(self, runs: Path, system: str = "", night: str = "", n_nights: int = N_NIGHTS) -> None:
        paths = [path for path in find_nights(runs, system or "*") if not night or path.parent.name <= night]
        if not paths or (night and paths[0].parent.name != night):
            known = ", ".join(dict.fromkeys(path.parent.name for path in find_nights(runs))) or "none"
            what = " ".join(filter(None, (system, night))) or "any system"
            raise ProductError(f"{runs}: no night log of {what}; there are: {known}")
        self.path = paths[0]
        self.system, self.night = system_of(self.path), self.path.parent.name
        self.entries = read_night(self.path)
        self.simulated = any(entry.simulated for entry in self.entries)
        earlier = [path for path in paths if path.name == self.path.name][:n_nights]
        self.nights: dict[str, Sequence[NightEntry]] = {
            path.parent.name: self.entries if path == self.path else read_night(path) for path in earlier
        }

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
        found = summarise(self.entries)
        rows = {}
        for name, (median, low, high) in found.items():
            label, unit = QUANTITIES[name]
            scale = 100.0 if name == "r0_m" else 1.0
            unit = "cm" if name == "r0_m" else unit
            rows[label] = f"{scale * median:.3g} ({scale * low:.3g} to {scale * high:.3g}) {unit}".rstrip()
        if "r0_m" in found and found["r0_m"][0] > 0.01:
            rows["Seeing at 500 nm"] = f"{seeing_arcsec(found['r0_m'][0]):.2f} arcsec"
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


def describe_entry(entry: NightEntry) -> str:
    """An entry other than a sample in words."""
    kind = _KIND_WORDS.get(entry.kind, "")
    author = entry.author if entry.kind == "note" else ""
    head = ", ".join(filter(None, (kind, author)))
    text = entry.text.removeprefix("FAULT: ") if entry.kind == "fault" else entry.text
    return f"{head}: {text}" if head else text
