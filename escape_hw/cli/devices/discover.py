"""``escape discover``."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.context import command_context


def discover(
    host: Annotated[
        list[str] | None,
        typer.Option("--host", metavar="NAME[:PORT]", help="Query this host, too; repeatable."),
    ] = None,
    json: options.Json = False,
) -> None:
    """Find devices without opening them, with their sections for the system's file.

    Exit code 1: none was found.
    """
    with command_context("discover", json=json) as context:
        from escape_hw.io.documents import header_fields
        from escape_hw.runtime.host.discovery import discover as search

        found = search(host or ())
        for device in found:
            used = f", in use by {', '.join(device.in_use_by)}" if device.in_use_by else ""
            serial = device.serial or "none"
            context.show(f"# {device.kind}: {device.model}, serial number {serial}, at {device.where}{used}")
            context.show(device.toml, "")
        if not found:
            context.notify(
                "no device was found; check permissions with 'escape doctor', name network hosts with --host"
            )
        devices = [asdict(device) for device in found]
        context.result({**header_fields("discover", None, None, None), "devices": devices}, met=bool(found))
