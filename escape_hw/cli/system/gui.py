"""``escape gui``: the window; it lives in a package of its own, which is found by its entry point."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from escape_hw.cli.context import command_context


def gui(
    system: Annotated[
        str | None,
        typer.Argument(
            help="System whose server to look at; one is started on the twin where none runs. Or a "
            "recording: a FITS product, the folder of a run."
        ),
    ] = None,
    connect: Annotated[
        str | None, typer.Option("--connect", metavar="ADDRESS", help="Look at this server: tcp://HOST:PORT.")
    ] = None,
    screenshot: Annotated[
        Path | None,
        typer.Option("--screenshot", metavar="FILE", help="Take a picture of the window, and end."),
    ] = None,
    reset_settings: Annotated[
        bool, typer.Option("--reset-settings", help="Forget look and layout of the last time.")
    ] = False,
) -> None:
    """Show the window: live views, calibrations, the loop."""
    with command_context("gui") as context:
        from escape_hw.config.registry import window_runner
        from escape_hw.errors import ConfigError

        if system and connect:
            raise ConfigError("a system or --connect, not both: an address says which system it is")
        context.code = window_runner()(system or "", connect or "", screenshot, reset_settings)


def replay(
    recording: Annotated[Path, typer.Argument(metavar="RUN", help="Folder of a run, or a FITS product.")],
    screenshot: Annotated[
        Path | None,
        typer.Option("--screenshot", metavar="FILE", help="Take a picture of the window, and end."),
    ] = None,
) -> None:
    """Show a finished run in the window, step by step if wanted."""
    with command_context("replay") as context:
        from escape_hw.config.registry import window_runner
        from escape_hw.errors import ProductError

        if not recording.is_dir() and not (recording.suffix == ".fits" and recording.is_file()):
            raise ProductError(f"{recording}: neither a product (.fits) nor the folder of a run")
        context.code = window_runner()(str(recording.absolute()), "", screenshot, False)
