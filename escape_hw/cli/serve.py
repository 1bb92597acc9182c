"""``escape serve``: one process that owns a system, for screens, scripts and notebooks."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig
    from escape_hw.remote.address import Listing

_LOOPBACK = "127.0.0.1"


def serve(
    system: options.System,
    port: Annotated[
        int | None,
        typer.Option(
            "--port", min=1, max=65534, help="Listen on TCP as well; events come from the next port."
        ),
    ] = None,
    bind: Annotated[
        str, typer.Option("--bind", metavar="ADDRESS", help="Address for --port; others need 'escape keys'.")
    ] = _LOOPBACK,
    read: Annotated[
        list[Path] | None,
        typer.Option("--read", metavar="FOLDER", help="Clients may load products from there; repeatable."),
    ] = None,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="DIR", help="Where runs go (default: your user data).")
    ] = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
    quiet: options.Quiet = False,
) -> None:
    """Own the devices of a system, and serve screens, scripts and notebooks until stopped."""
    with session("serve", json=json, quiet=quiet) as one:
        from escape_hw.errors import ConfigError
        from escape_hw.io.run_folder import default_base
        from escape_hw.server.serving import Serving

        if port is None and bind != _LOOPBACK:
            raise ConfigError(f"--bind {bind} needs a --port; without one nothing listens on the network")
        config = one.configured(options.Choice.of(system, set, seed, mode))
        runs = default_base() if out is None else out.expanduser().absolute()
        with Serving(config, bind, port) as serving:
            _tell(one, config, serving.listing)
            with one.interrupts.procedure() as stop:
                one.was_opened = True
                serving.run(stop, runs, tuple(read or ()))
            one.interrupts.begin_closing()
        one.tell("serve: stopped, mirror flat")


def _tell(one: Session, config: SystemConfig, listing: Listing) -> None:
    from dataclasses import asdict

    from escape_hw.io.documents import head

    name = config.system.name
    document = head("serve", name, config.simulated, config.system.seed)
    one.result({**document, **asdict(listing)})
    # Whoever reads the document waits for it, and not for the end.
    one.print_document()
    kind = "simulated" if config.simulated else "HARDWARE"
    where = f", {listing.tcp}" if listing.tcp else ""
    one.tell(f"serve: {name} ({kind}), process {listing.pid}{where}; Ctrl-C ends it")
    one.tell(f"serve: look at it with 'escape gui --connect {name}', or escape_hw.connect(\"{name}\")")
