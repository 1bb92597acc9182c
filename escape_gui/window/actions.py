"""Table of the window's actions, from which menus, shortcuts and tooltips are built; pages of keys and help.

What each action does is in :meth:`escape_gui.main_window.MainWindow.handlers`.
"""

from __future__ import annotations

from dataclasses import dataclass
from html import escape
from importlib.resources import files

from PySide6.QtGui import QKeySequence

from escape_gui.client.availability import (
    UnavailableReason,
    always_available,
    reason_no_abort,
    reason_no_change,
    reason_no_clear_fault,
    reason_no_pause,
    reason_no_release,
    reason_no_request,
    reason_no_take_control,
)
from escape_gui.panels.base import Panel
from escape_gui.window.docks import WORKSPACES


@dataclass(frozen=True, slots=True)
class Action:
    """Description of an action."""

    #: Identifier: one or two words with an underscore.
    name: str
    #: Menu and entry; ``&`` marks the letter to press with Alt.
    menu: str
    text: str
    #: Tooltip, one sentence.
    tip: str
    #: Shortcuts; tooltips and menus show the first.
    keys: tuple[str, ...] = ()
    #: Returns the reason why the action is unavailable in a context, empty if it is available.
    unavailable: UnavailableReason = always_available


MENUS = ("&File", "&View", "&Loop", "&Help")

# fmt: off
ACTIONS: tuple[Action, ...] = (
    Action("connect", "&File", "&Connect…", "Connect to another server, or start one here.",
           ("Ctrl+Shift+C",)),
    Action("open_product", "&File", "&Open product…", "Show a FITS product in these panels.", ("Ctrl+O",)),
    Action("runs", "&File", "Runs and &matrices…", "Finished runs: load a matrix into the loop, or replay.",
           ("Ctrl+M",)),
    Action("open_run", "&File", "Open &run folder…", "Replay a finished run in these panels.",
           ("Ctrl+Alt+O",)),
    Action("save_png", "&File", "Save panel as &image…", "Save the panel with the focus as PNG.",
           ("Ctrl+S",)),
    Action("save_csv", "&File", "Save panel as &table…", "Save the data of the panel with the focus as CSV.",
           ("Ctrl+Alt+S",)),
    Action("save_fits", "&File", "Save panel as &FITS…", "Save the data of the panel with the focus as FITS.",
           ("Ctrl+Shift+S",)),
    Action("save_window", "&File", "Save &window as image…", "Save the whole window as PNG.",
           ("Ctrl+Shift+P",)),
    Action("quit", "&File", "&Quit", "Close the window; asks while a procedure runs or the loop is closed.",
           ("Ctrl+Q",)),
    *(
        Action(f"workspace_{one.name}", "&View", f"&{number} {one.title}", f"{one.purpose}.",
               (f"Ctrl+{number}",))
        for number, one in enumerate(WORKSPACES, 1)
    ),
    Action("reset_layout", "&View", "&Reset this layout",
           "Restore the default arrangement of this workspace."),
    Action("next_panel", "&View", "&Next panel", "Move the focus to the next panel.", ("F6",)),
    Action("previous_panel", "&View", "Pre&vious panel", "Move the focus to the previous panel.",
           ("Shift+F6",)),
    Action("freeze", "&View", "F&reeze the panels", "Freeze all panels; press again to resume.", ("X",)),
    Action("theme", "&View", "&Toggle dark/light theme", "Change between the dark and the light palette.",
           ("Ctrl+T",)),
    Action("larger", "&View", "&Increase font size", "Increase the font size everywhere.",
           ("Ctrl++", "Ctrl+=")),
    Action("smaller", "&View", "&Decrease font size", "Decrease the font size everywhere.", ("Ctrl+-",)),
    Action("normal", "&View", "Reset font si&ze", "Use the default font size.", ("Ctrl+0",)),
    Action("open_loop", "&Loop", "&Open loop", "Open the loop and flatten the mirror immediately.",
           ("Ctrl+Shift+O",), reason_no_request),
    Action("flatten", "&Loop", "&Flatten", "Stop all activity and ramp the mirror flat immediately.",
           ("Ctrl+Shift+F",), reason_no_request),
    Action("abort", "&Loop", "&Abort procedure", "Stop the procedure and save the data acquired so far.",
           ("Ctrl+Shift+A",), reason_no_abort),
    Action("pause", "&Loop", "&Pause / resume", "Pause the procedure between two steps, or resume it.",
           ("Ctrl+P",), reason_no_pause),
    Action("take_control", "&Loop", "&Take control", "Request control; other clients become read-only.",
           ("Ctrl+L",), reason_no_take_control),
    Action("give_back", "&Loop", "Re&lease control", "Release control for other clients.",
           ("Ctrl+Shift+L",), reason_no_release),
    Action("record", "&Loop", "&Record telemetry with images",
           "Start or stop recording everything. The panel Telemetry records some seconds, without images.",
           ("Ctrl+R",), reason_no_change),
    Action("alarms", "&View", "A&larms…", "Set the limits of the alarms, or mute them."),
    Action("acknowledge", "&View", "Ac&knowledge alarms", "Acknowledge all alarms.", ("Ctrl+K",)),
    Action("clear_fault", "&Loop", "&Clear fault", "Clear the latched fault and enable the mirror.",
           (), reason_no_clear_fault),
    Action("help_panel", "&Help", "This &panel", "Help on the panel with the focus.", ("F1",)),
    Action("keys", "&Help", "&Keyboard", "All keyboard shortcuts.", ("H", "Ctrl+/")),
)
# fmt: on


#: Keys of an image that has the focus.
IMAGE_KEYS = (
    ("A", "autoscale once"),
    ("L", "logarithmic or linear"),
    ("R or double click", "reset view"),
    ("click or Enter", "cross-section through this pixel; choose this actuator"),
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
