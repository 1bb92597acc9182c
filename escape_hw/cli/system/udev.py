"""``escape udev``: device rules and limits of this computer."""

from __future__ import annotations

import getpass
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext

if TYPE_CHECKING:
    from escape_hw.runtime.host.udev import Change

app = typer.Typer(help="Permissions, names and limits for real devices.", no_args_is_help=True)
Root = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Install below this folder, such as a disk image.")
]


@app.command("show")
@command("udev show")
def show(context: CommandContext, root: Root = Path("/")) -> None:
    """Show what is installed and what 'install' would change."""
    from escape_hw.runtime.host.udev import plan_changes

    changes = plan_changes(root)
    context.show(*_format_changes(changes))
    context.report(changed=False, files=[_to_dict(one) for one in changes], written=[])


@app.command("install")
@command("udev install")
def install(
    context: CommandContext,
    root: Root = Path("/"),
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
) -> None:
    """Show the changes, ask, and apply them. Exit code 1: changes are needed but were not applied."""
    from escape_hw.runtime.host import udev

    changes = udev.plan_changes(root)
    due = [change for change in changes if change.condition != "installed"]
    context.show(*_format_changes(changes))
    written: list[Path] = []
    if due and not udev.is_writable(due):
        context.notify(f"not permitted; run: sudo {Path(sys.argv[0]).absolute()} udev install")
    elif due and (yes or _confirm(context)):
        written = udev.apply_changes(due)
        context.show(*(f"written: {path}" for path in written))
        for failure in udev.reload_rules() if root == Path("/") else ():
            context.notify(failure)
    steps = udev.remaining_commands(getpass.getuser())
    context.show("remaining manual steps, once:", *(f"  {step}" for step in steps))
    files = [_to_dict(one) for one in changes]
    context.report(met=len(written) == len(due), changed=bool(written), files=files, written=written)


def _confirm(context: CommandContext) -> bool:
    """Ask on a terminal; without one the answer is no."""
    if context.json or not sys.stdin.isatty():
        context.notify("nothing was changed; use --yes to apply the changes without confirmation")
        return False
    return typer.confirm("Apply these changes?", err=True)


def _format_changes(changes: list[Change]) -> list[str]:
    lines = []
    for change in changes:
        lines.append(f"{change.target}: {change.condition}")
        lines += [f"    {line}" for line in change.difference.splitlines()]
    return lines


def _to_dict(change: Change) -> dict[str, Any]:
    return {key: getattr(change, key) for key in ("source", "target", "condition", "difference")}
