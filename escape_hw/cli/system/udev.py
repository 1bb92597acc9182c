"""``escape udev``: rules and limits of the machine."""

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
    """Tell what is installed and what 'install' would change; changes nothing."""
    with command_context("udev show", json=json) as context:
        from escape_hw.runtime.host.udev import plan_changes

        changes = plan_changes(root)
        context.show(*_format_changes(changes))
        _result(context, "udev show", changes, [])


@app.command("install")
def install(
    root: Root = Path("/"),
    yes: Annotated[bool, typer.Option("--yes", help="Do it without asking.")] = False,
    json: options.Json = False,
) -> None:
    """Show what would change, ask, and change it. Exit code 1: nothing was changed, but should be."""
    with command_context("udev install", json=json) as context:
        from escape_hw.runtime.host import udev

        changes = udev.plan_changes(root)
        due = [change for change in changes if change.condition != "installed"]
        context.show(*_format_changes(changes))
        written: list[Path] = []
        if due and not udev.is_writable(due):
            context.notify(
                f"not permitted; give this command: sudo {Path(sys.argv[0]).absolute()} udev install"
            )
        elif due and (yes or _confirm(context)):
            written = udev.apply_changes(due)
            context.show(*(f"written: {path}" for path in written))
            for failure in udev.reload_rules() if root == Path("/") else ():
                context.notify(failure)
        steps = udev.remaining_commands(getpass.getuser())
        context.show("still to be done by hand, once:", *(f"  {step}" for step in steps))
        _result(context, "udev install", changes, written, met=len(written) == len(due))


def _confirm(context: CommandContext) -> bool:
    """Ask, where there is somebody to ask."""
    if context.json or not sys.stdin.isatty():
        context.notify("nothing was changed; say --yes to have it done without being asked")
        return False
    return typer.confirm("Change it?", err=True)


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

    files = [
        {
            "source": change.source,
            "target": change.target,
            "condition": change.condition,
            "difference": change.difference,
        }
        for change in changes
    ]
    document = {**header_fields(command, None, None, None), "changed": bool(written)}
    context.result({**document, "files": files, "written": written}, met=met)
