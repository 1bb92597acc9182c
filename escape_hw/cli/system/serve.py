"""``escape serve``: a server that owns a system, for windows, scripts and notebooks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig
    from escape_hw.remote.address import ServerListing

_LOOPBACK = "127.0.0.1"


@command("serve", quiet=True)
def serve(
    context: CommandContext,
    selection: options.Selection,
    port: Annotated[
        int | None,
        typer.Option("--port", min=1, max=65534, help="Listen on TCP as well; events use the next port."),
    ] = None,
    bind: Annotated[
        str, typer.Option("--bind", metavar="ADDRESS", help="Address for --port; others need 'escape keys'.")
    ] = _LOOPBACK,
    read: Annotated[
        list[Path] | None,
        typer.Option("--read", metavar="FOLDER", help="Folder that clients may load from; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Parent of run folders (default: user data).")
    ] = None,
) -> None:
    """Open the devices of a system, and serve windows, scripts and notebooks until stopped."""
    from escape_hw.io.run_folder import default_runs_folder
    from escape_hw.io.storage import check_readable, check_writable, make_folder
    from escape_hw.server.frontend.supervisor import FrontEndSupervisor

    if port is None and bind != _LOOPBACK:
        raise ConfigError(f"--bind {bind} needs --port; without it the server has local sockets only")
    config = context.load_config(selection)
    runs = default_runs_folder() if out is None else out.expanduser().absolute()
    read_folders = tuple(folder.expanduser().absolute() for folder in read or ())
    make_folder(runs)
    check_writable(runs)
    for folder in read_folders:
        check_readable(folder)
    supervisor = FrontEndSupervisor(config, bind, port, runs, read_folders)
    with context.interrupts.protect_closing(supervisor) as server:
        _print_listing(context, config, server.listing)
        with context.interrupts.procedure() as stop:
            context.devices_opened = True
            server.run(stop)
    context.notify("serve: stopped, mirror flat")


def _print_listing(context: CommandContext, config: SystemConfig, listing: ServerListing) -> None:
    from dataclasses import asdict

    name = config.system.name
    context.report(**asdict(listing))
    # Printed now: programs that start a server read its addresses while it runs.
    context.print_document()
    kind = "simulated" if config.simulated else "HARDWARE"
    where = f", {listing.tcp}" if listing.tcp else ""
    context.notify(f"serve: {name} ({kind}), process {listing.pid}{where}; Ctrl-C ends it")
    context.notify(f"serve: connect with 'escape gui {name}' or escape_hw.connect(\"{name}\")")
