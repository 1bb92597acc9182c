"""``escape discover``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext


@command("discover")
def discover(
    context: CommandContext,
    host: Annotated[
        list[str] | None,
        typer.Option("--host", metavar="NAME[:PORT]", help="Query this host, too; repeatable."),
    ] = None,
) -> None:
    """Find devices without opening them, with their sections for the system's file.

    Exit code 1: none was found.
    """
    from escape_hw.runtime.host.discovery import discover as search

    found = search(host or ())
    for device in found:
        used = f", in use by {', '.join(device.in_use_by)}" if device.in_use_by else ""
        serial = device.serial or "none"
        context.show(f"# {device.kind}: {device.model}, serial number {serial}, at {device.where}{used}")
        context.show(device.toml, "")
    if not found:
        hosts = f"none answers on {', '.join(host)}" if host else "name network hosts with --host"
        context.notify(f"no device was found; check permissions with 'escape doctor', {hosts}")
    context.report(met=bool(found), devices=[asdict(device) for device in found])
