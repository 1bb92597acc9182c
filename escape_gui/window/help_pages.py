"""Help pages of the panels and the table of keyboard shortcuts."""

from __future__ import annotations

from html import escape
from importlib.resources import files

from PySide6.QtGui import QKeySequence

from escape_gui.panels.base import Panel
from escape_gui.window.actions import ACTIONS, MENUS

#: Keys of the pictures, which work while one of them has the focus.
IMAGE_KEYS = (
    ("A", "levels once from what is shown now"),
    ("L", "logarithmic or linear"),
    ("R", "whole picture again"),
    ("M", "next colour map"),
    ("arrows", "move the cursor by a pixel"),
)


def keyboard_table() -> str:
    """HTML of the page."""
    parts = ["<table cellspacing='6'>"]
    for menu in MENUS:
        rows = [(one, format_shortcuts(one.keys)) for one in ACTIONS if one.menu == menu and one.keys]
        parts.append(f"<tr><td colspan='3'><b>{menu.replace('&', '')}</b></td></tr>")
        for one, keys in rows:
            parts.append(_row(keys, one.text.replace("&", "").rstrip("…"), one.tip))
    parts.append("<tr><td colspan='3'><b>Pictures (click one first)</b></td></tr>")
    parts += [_row(key, text, "") for key, text in IMAGE_KEYS]
    parts.append(_row("Tab, Space, Enter", "go on, press", "Hold Space on a button that says so."))
    return "".join([*parts, "</table>"])


def format_shortcuts(keys: tuple[str, ...]) -> str:
    """Shortcuts as the system writes them."""
    form = QKeySequence.SequenceFormat.NativeText
    return " or ".join(QKeySequence(key).toString(form) for key in keys)


def _row(keys: str, text: str, tip: str) -> str:
    return f"<tr><td><code>{escape(keys)}</code></td><td>{escape(text)}</td><td>{escape(tip)}</td></tr>"


def help_page(panel: Panel) -> str:
    """The page of a panel; its own two sentences where no page was written."""
    path = files("escape_gui") / "help" / f"{panel.name}.md"
    return path.read_text(encoding="utf-8") if path.is_file() else panel.help
