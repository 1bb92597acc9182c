"""Pieces of a self-contained HTML page; everything that is shown is escaped here."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from html import escape as escape
from importlib import resources
from typing import Any
from urllib.parse import quote

from matplotlib.figure import Figure

from escape_hw.report.figures import style
from escape_hw.report.tables import Table, criterion_symbol

_CRITERION_CLASSES = {"✓": "good", "!": "limited", "✗": "bad"}


def page(title: str, banners: Sequence[tuple[str, str]], body: Sequence[str]) -> str:
    """A whole page; ``banners`` are (class, text) pairs across the top."""
    top = "".join(f'<div class="band {kind}" role="status">{escape(text)}</div>' for kind, text in banners)
    css = resources.files("escape_hw.report").joinpath("report.css").read_text(encoding="utf-8")
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{escape(title)}</title><style>{css}</style></head>\n"
        f"<body>{top}<main>\n" + "\n".join(body) + "\n</main></body></html>\n"
    )


def section(title: str, *parts: str) -> str:
    """A section with a heading; nothing when all parts are empty."""
    inside = "\n".join(part for part in parts if part)
    return f"<section><h2>{escape(title)}</h2>\n{inside}</section>" if inside else ""


def key_values(values: Mapping[str, str]) -> str:
    """Headline numbers."""
    cells = "".join(f"<div><dt>{escape(k)}</dt><dd>{escape(v)}</dd></div>" for k, v in values.items())
    return f'<dl class="facts">{cells}</dl>'


def table(content: Table, caption: str = "") -> str:
    """A table in the book style: rules above, below and under the headings."""
    head = "".join(f'<th scope="col">{escape(heading)}</th>' for heading in content.headings)
    rows = "".join(
        "<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in content.rows
    )
    below = f"<caption>{escape(caption)}</caption>" if caption else ""
    kind = "" if content.numeric else ' class="text"'
    inside = f"{below}<thead><tr>{head}</tr></thead><tbody>{rows}</tbody>"
    return f'<div class="wide"><table{kind}>{inside}</table></div>'


def figure(key: str, content: Figure, caption: str) -> str:
    """A figure as inline SVG with its caption."""
    # The same scale for all: text is equally large in wide and in narrow figures.
    width = f'style="max-width:{6.7 * content.get_figwidth():.1f}rem"'
    drawing = style.svg(content, key)
    drawing = drawing.replace("<svg", f'<svg role="img" aria-labelledby="{key}-caption" {width}', 1)
    return f'<figure>{drawing}<figcaption id="{key}-caption">{escape(caption)}</figcaption></figure>'


def criteria_list(criteria: Sequence[Mapping[str, Any]]) -> str:
    """Criteria with a tick, a cross, or an exclamation mark where met with a limitation."""
    items = "".join(
        f'<li class="{_CRITERION_CLASSES[symbol]}">{symbol} {escape(check["text"])}</li>'
        for check in criteria
        for symbol in [criterion_symbol(check)]
    )
    return f'<ul class="checks">{items}</ul>' if items else ""


def link(target: str, text: str) -> str:
    """A link to a file in the folder of the page."""
    return f'<a href="{escape(quote(target))}">{escape(text)}</a>'


def figure_row(*parts: str) -> str:
    """Figures side by side where the page is wide enough."""
    inside = "".join(part for part in parts if part)
    return f'<div class="two">{inside}</div>' if inside else ""


def note_list(lines: Sequence[str], kind: str = "") -> str:
    """A list of remarks."""
    items = "".join(f"<li>{escape(line)}</li>" for line in lines)
    return f'<ul class="notes {kind}">{items}</ul>' if lines else ""


def collapsible(summary: str, text: str) -> str:
    """Long text behind a heading that opens."""
    return f"<details><summary>{escape(summary)}</summary><pre>{escape(text)}</pre></details>" if text else ""
