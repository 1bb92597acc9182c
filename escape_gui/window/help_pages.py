"""Help pages of the panels and the table of keyboard shortcuts."""

from __future__ import annotations

from html import escape
from importlib.resources import files

from PySide6.QtGui import QKeySequence

from escape_gui.panels.base import Panel
from escape_gui.window.actions import ACTIONS, MENUS

#: Keys of an image that has the focus.
IMAGE_KEYS = (
    ("A", "autoscale once"),
    ("L", "logarithmic or linear"),
    ("R", "reset view"),
    ("M", "next colour map"),
    ("arrows", "move the cursor by a pixel"),
)


def keyboard_table() -> str:
    """Table of all keyboard shortcuts, as HTML."""
    lines = []
    for menu in MENUS:
        lines.append(_heading(menu.replace("&", "")))
        lines += [
            _line(format_shortcuts(one.keys), one.text.replace("&", "").rstrip("…"), one.tip)
            for one in ACTIONS
            if one.menu == menu and one.keys
        ]
    lines.append(_heading("Images (click one first)"))
    lines += [_line(key, text) for key, text in IMAGE_KEYS]
    lines.append(_line("Tab, Space, Enter", "next, press", "Hold Space on a button labelled 'Hold to'."))
    return f"<table cellspacing='6'>{''.join(lines)}</table>"


def format_shortcuts(keys: tuple[str, ...]) -> str:
    """Shortcuts in the notation of the operating system."""
    form = QKeySequence.SequenceFormat.NativeText
    return " or ".join(QKeySequence(key).toString(form) for key in keys)


def _heading(text: str) -> str:
    return f"<tr><td colspan='3'><b>{text}</b></td></tr>"


def _line(keys: str, text: str, tip: str = "") -> str:
    return f"<tr><td><code>{escape(keys)}</code></td><td>{escape(text)}</td><td>{escape(tip)}</td></tr>"


def help_page(panel: Panel) -> str:
    """Help page of a panel in Markdown; its short help if there is no page."""
    path = files("escape_gui") / "help" / f"{panel.name}.md"
    return path.read_text(encoding="utf-8") if path.is_file() else panel.help
