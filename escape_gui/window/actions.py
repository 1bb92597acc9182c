"""Everything the window can do, in one table: menus, shortcuts, tooltips and the key map are made of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

from escape_gui.client.availability import (
    UnavailableReason,
    always_available,
    reason_no_abort,
    reason_no_clear_fault,
    reason_no_pause,
    reason_no_release,
    reason_no_request,
    reason_no_take_control,
    reason_no_write,
)
from escape_gui.window.workspaces import WORKSPACES

if TYPE_CHECKING:
    from escape_gui.main_window import MainWindow


@dataclass(frozen=True, slots=True)
class Action:
    """One thing the window can do.

    Parameters
    ----------
    name
        One word or two with an underscore.
    menu, text
        Where it stands and what it is called; ``&`` marks the letter to press with Alt.
    tip
        What it does, one sentence.
    run
        Does it.
    keys
        Shortcuts, the first is shown.
    obstacle
        Why it is impossible now.
    """

    name: str
    menu: str
    text: str
    tip: str
    run: Callable[[MainWindow], object]
    keys: tuple[str, ...] = ()
    unavailable: UnavailableReason = always_available


MENUS = ("&File", "&View", "&Loop", "&Help")


def _workspaces() -> tuple[Action, ...]:
    return tuple(
        Action(
            f"workspace_{one.name}",
            "&View",
            f"&{number} {one.title}",
            f"{one.purpose}.",
            lambda window, name=one.name: window.show_workspace(name),  # type: ignore[misc]
            (f"Ctrl+{number}",),
        )
        for number, one in enumerate(WORKSPACES, 1)
    )


ACTIONS: tuple[Action, ...] = (
    Action(
        "open_product",
        "&File",
        "&Open product…",
        "Show a FITS product in these panels.",
        lambda w: w.replay.ask_product(),
        ("Ctrl+O",),
    ),
    Action(
        "open_run",
        "&File",
        "Open &run folder…",
        "Show a finished run in these panels, step by step if wanted.",
        lambda w: w.replay.ask_run(),
        ("Ctrl+Alt+O",),
    ),
    Action(
        "save_png",
        "&File",
        "Save panel as &picture…",
        "Save the panel with the focus as PNG.",
        lambda w: w.exporter.panel("png"),
        ("Ctrl+S",),
    ),
    Action(
        "save_csv",
        "&File",
        "Save panel as &table…",
        "Save the numbers of the panel with the focus as CSV.",
        lambda w: w.exporter.panel("csv"),
        ("Ctrl+Alt+S",),
    ),
    Action(
        "save_fits",
        "&File",
        "Save panel as &FITS…",
        "Save the arrays of the panel with the focus as FITS.",
        lambda w: w.exporter.panel("fits"),
        ("Ctrl+Shift+S",),
    ),
    Action(
        "save_window",
        "&File",
        "Save &window as picture…",
        "Save the whole window as PNG.",
        lambda w: w.exporter.window(),
        ("Ctrl+Shift+P",),
    ),
    Action(
        "quit",
        "&File",
        "&Quit",
        "Close the window; a server it is connected to goes on.",
        lambda w: w.close(),
        ("Ctrl+Q",),
    ),
    *_workspaces(),
    Action(
        "reset_layout",
        "&View",
        "&Reset this layout",
        "Put the panels of this workspace back in place.",
        lambda w: w.reset_layout(),
    ),
    Action(
        "next_panel",
        "&View",
        "&Next panel",
        "Give the focus to the next panel.",
        lambda w: w.focus_panel(+1),
        ("F6",),
    ),
    Action(
        "previous_panel",
        "&View",
        "Pre&vious panel",
        "Give the focus to the panel before.",
        lambda w: w.focus_panel(-1),
        ("Shift+F6",),
    ),
    Action(
        "freeze",
        "&View",
        "F&reeze the panels",
        "Hold every panel as it is; the same key goes on.",
        lambda w: w.toggle_freeze(),
        ("X",),
    ),
    Action(
        "theme",
        "&View",
        "&Dark or light",
        "Change between the dark and the light palette.",
        lambda w: w.toggle_theme(),
        ("Ctrl+T",),
    ),
    Action(
        "larger",
        "&View",
        "&Larger letters",
        "Larger letters everywhere.",
        lambda w: w.step_font_scale(+1),
        ("Ctrl++", "Ctrl+="),
    ),
    Action(
        "smaller",
        "&View",
        "&Smaller letters",
        "Smaller letters everywhere.",
        lambda w: w.step_font_scale(-1),
        ("Ctrl+-",),
    ),
    Action(
        "normal",
        "&View",
        "Normal letter si&ze",
        "Letters of normal size.",
        lambda w: w.step_font_scale(0),
        ("Ctrl+0",),
    ),
    Action(
        "open_loop",
        "&Loop",
        "&Open loop",
        "Open the loop and flatten the mirror, at once.",
        lambda w: w.ask("open the loop", lambda server: server.open_loop(), urgent=True),
        ("Ctrl+Shift+O",),
        reason_no_request,
    ),
    Action(
        "flatten",
        "&Loop",
        "&Flatten",
        "Stop whatever goes on and ramp the mirror flat, at once.",
        lambda w: w.ask("flatten the mirror", lambda server: server.flatten(), urgent=True),
        ("Ctrl+Shift+F",),
        reason_no_request,
    ),
    Action(
        "abort",
        "&Loop",
        "&Abort procedure",
        "Stop the procedure; what was measured is kept.",
        lambda w: w.ask("abort the procedure", lambda server: server.abort(), urgent=True),
        ("Ctrl+Shift+A",),
        reason_no_abort,
    ),
    Action(
        "pause",
        "&Loop",
        "&Pause or go on",
        "Halt the procedure between two steps, or go on with it.",
        lambda w: w.toggle_pause(),
        ("Ctrl+P",),
        reason_no_pause,
    ),
    Action(
        "take_control",
        "&Loop",
        "&Take control",
        "Ask for the right to change things; others then watch.",
        lambda w: w.take_control(),
        ("Ctrl+L",),
        reason_no_take_control,
    ),
    Action(
        "give_back",
        "&Loop",
        "&Give control back",
        "Let somebody else take control.",
        lambda w: w.ask("give control back", lambda server: server.release()),
        ("Ctrl+Shift+L",),
        reason_no_release,
    ),
    Action(
        "record",
        "&Loop",
        "&Record telemetry",
        "Begin or end recording every frame to disk.",
        lambda w: w.toggle_recording(),
        ("Ctrl+R",),
        reason_no_write,
    ),
    Action(
        "clear_fault",
        "&Loop",
        "&Clear fault",
        "You have looked: let the mirror move again.",
        lambda w: w.ask("clear the fault", lambda server: server.clear_fault()),
        (),
        reason_no_clear_fault,
    ),
    Action(
        "help_panel",
        "&Help",
        "This &panel",
        "What the panel with the focus shows.",
        lambda w: w.show_panel_help(),
        ("F1",),
    ),
    Action(
        "keys",
        "&Help",
        "&Keyboard",
        "All keys on one page.",
        lambda w: w.toggle_keyboard_table(),
        ("H", "Ctrl+/"),
    ),
)


def action(name: str) -> Action:
    """The action of that name."""
    return next(one for one in ACTIONS if one.name == name)
