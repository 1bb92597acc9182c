"""``escape udev``: rules and limits of the machine."""

from __future__ import annotations

import getpass
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.runtime.udev import Change

app = typer.Typer(help="Permissions, names and limits for real devices.", no_args_is_help=True)
Root = Annotated[
    Path, typer.Option("--root", metavar="DIR", help="Install below this folder, such as a disk image.")
]


@app.command("show")
def show(root: Root = Path("/"), json: options.Json = False) -> None:
    """Tell what is installed and what 'install' would change; changes nothing."""
    with session("udev show", json=json) as one:
        from escape_hw.runtime.udev import plan

        changes = plan(root)
        one.show(*_lines(changes))
        _result(one, "udev show", changes, [])


@app.command("install")
def install(
    root: Root = Path("/"),
    yes: Annotated[bool, typer.Option("--yes", help="Do it without asking.")] = False,
    json: options.Json = False,
) -> None:
    """Show what would change, ask, and change it. Exit code 1: nothing was changed, but should be."""
    with session("udev install", json=json) as one:
        from escape_hw.runtime import udev

        changes = udev.plan(root)
        due = [change for change in changes if change.condition != "installed"]
        one.show(*_lines(changes))
        written: list[Path] = []
        if due and not udev.writable(due):
            one.tell(f"not permitted; give this command: sudo {Path(sys.argv[0]).absolute()} udev install")
        elif due and (yes or _agreed(one)):
            written = udev.apply(due)
            one.show(*(f"written: {path}" for path in written))
            for failure in udev.reload_rules() if root == Path("/") else ():
                one.tell(failure)
        steps = udev.further_steps(getpass.getuser())
        one.show("still to be done by hand, once:", *(f"  {step}" for step in steps))
        _result(one, "udev install", changes, written, met=len(written) == len(due))


def _agreed(one: Session) -> bool:
    """Ask, where there is somebody to ask."""
    if one.json or not sys.stdin.isatty():
        one.tell("nothing was changed; say --yes to have it done without being asked")
        return False
    return typer.confirm("Change it?", err=True)


def _lines(changes: list[Change]) -> list[str]:
    lines = []
    for change in changes:
        lines.append(f"{change.target}: {change.condition}")
        lines += [f"    {line}" for line in change.difference.splitlines()]
    return lines


def _result(one: Session, command: str, changes: list[Change], written: list[Path], met: bool = True) -> None:
    from escape_hw.io.documents import head

    files = [
        {
            "source": change.source,
            "target": change.target,
            "condition": change.condition,
            "difference": change.difference,
        }
        for change in changes
    ]
    document = {**head(command, None, None, None), "changed": bool(written)}
    one.result({**document, "files": files, "written": written}, met=met)
