"""``escape gui`` and ``escape replay``: start the window, which is found by its entry point."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from escape_hw.cli.context import command_context
from escape_hw.errors import ConfigError, ProductError


def gui(
    system: Annotated[
        str | None,
        typer.Argument(
            help="System to connect to; its server is started in simulation if none runs. Or a recording: "
            "a FITS product or a run folder."
        ),
    ] = None,
    connect: Annotated[
        str | None,
        typer.Option("--connect", metavar="ADDRESS", help="Connect to this server: tcp://HOST:PORT."),
    ] = None,
    screenshot: Annotated[
        Path | None,
        typer.Option("--screenshot", metavar="FILE", help="Save an image of the window and exit."),
    ] = None,
    reset_settings: Annotated[
        bool, typer.Option("--reset-settings", help="Discard the saved appearance and layout.")
    ] = False,
) -> None:
    """Open the window: live views, calibrations, the loop."""
    with command_context("gui") as context:
        from escape_hw.config.registry import window_runner
        from escape_hw.io.storage import refuse_existing

        if system and connect:
            raise ConfigError("give a system or --connect, not both")
        refuse_existing(screenshot)
        context.code = window_runner()(system or "", connect or "", screenshot, reset_settings)


def replay(
    recording: Annotated[Path, typer.Argument(metavar="RUN", help="Run folder or FITS product.")],
    screenshot: Annotated[
        Path | None,
        typer.Option("--screenshot", metavar="FILE", help="Save an image of the window and exit."),
    ] = None,
) -> None:
    """Replay a finished run in the window."""
    with command_context("replay") as context:
        from escape_hw.config.registry import window_runner
        from escape_hw.io.storage import refuse_existing

        refuse_existing(screenshot)
        if not recording.is_dir() and not (recording.suffix == ".fits" and recording.is_file()):
            raise ProductError(f"{recording}: neither a product (.fits) nor the folder of a run")
        context.code = window_runner()(str(recording.absolute()), "", screenshot, False)
