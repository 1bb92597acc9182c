"""Help pages of the panels: Markdown files that come with the package."""

from __future__ import annotations

from importlib.resources import files

from escape_gui.panels.panel import Panel


def page(panel: Panel) -> str:
    """The page of a panel; its own two sentences where no page was written."""
    path = files("escape_gui") / "help" / f"{panel.name}.md"
    return path.read_text(encoding="utf-8") if path.is_file() else panel.help
