"""``escape udev``: device rules and limits of this computer."""

from __future__ import annotations

import getpass
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.context import CommandContext, command_context

if TYPE_CHECKING:
    from escape_hw.runtime.host.udev import Change

app = typer.Typer(help="Permissions, names and limits for real devices.", no_args_is_help=True)
Root = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Install below this folder, such as a disk image.")
]


@app.command("show")
def show(root: Root = Path("/"), json: options.Json = False) -> None:
    """Show what is installed and what 'install' would change."""
    with command_context("udev show", json=json) as context:
        from escape_hw.runtime.host.udev import plan_changes

        changes = plan_changes(root)
        context.show(*_format_changes(changes))
        _result(context, "udev show", changes, [])


@app.command("install")
def install(
    root: Root = Path("/"),
    yes: Annotated[bool, typer.Option("--yes", help="Do not ask for confirmation.")] = False,
    json: options.Json = False,
) -> None:
    """Show the changes, ask, and apply them. Exit code 1: changes are needed but were not applied."""
    with command_context("udev install", json=json) as context:
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
        _result(context, "udev install", changes, written, met=len(written) == len(due))


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


def _result(
    context: CommandContext, command: str, changes: list[Change], written: list[Path], met: bool = True
) -> None:
    from escape_hw.io.documents import header_fields

    keys = ("source", "target", "condition", "difference")
    files = [{key: getattr(change, key) for key in keys} for change in changes]
    document = {**header_fields(command, None, None, None), "changed": bool(written)}
    context.result({**document, "files": files, "written": written}, met=met)
