"""``escape systems`` and ``escape config``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.completion import complete_system
from escape_hw.cli.context import CommandContext

if TYPE_CHECKING:
    from escape_hw.config.system import SystemConfig

config_app = typer.Typer(help="Check, create and describe configurations.", no_args_is_help=True)


@command("systems")
def systems(context: CommandContext) -> None:
    """List the systems that come with the package."""
    from escape_hw.cli.formatting import rich_table
    from escape_hw.config.bundled import bundled_systems
    from escape_hw.config.loader import load_system
    from escape_hw.report.tables import Table

    rows = [_describe(load_system(name)) for name in bundled_systems()]
    headings = ("system", "mode", "actuators", "modes", "description")
    keys = ("name", "mode", "n_act", "n_modes", "description")
    cells = tuple(tuple(str(row[key]) for key in keys) for row in rows)
    context.show(rich_table(Table(headings, cells, numeric=False)))
    context.report(systems=rows)


def _describe(config: SystemConfig) -> dict[str, Any]:
    return {
        "name": config.system.name, "description": config.system.description, "mode": config.system.mode,
        "sensor": config.sensor.kind, "n_act": config.devices.dm.n_act, "n_modes": config.basis.n_modes,
    }  # fmt: skip


@config_app.command("check")
@command("config check")
def check(
    context: CommandContext,
    selection: Annotated[
        options.SystemSelection,
        typer.Argument(
            metavar="FILE", help="TOML file, or the name of a system.", autocompletion=complete_system
        ),
    ],
) -> None:
    """Check a configuration; reports all errors with file, line, key and allowed range."""
    config = context.load_config(selection)
    context.show(f"{selection.system}: valid ({config.system.name}, mode {config.system.mode})")
    context.report(file=selection.system, valid=True)


@config_app.command("init")
@command("config init")
def init(
    context: CommandContext,
    name: Annotated[str, typer.Argument(help="Name of the new system.")] = "my-system",
    base: Annotated[
        str, typer.Option("--base", help="System whose values are used.", autocompletion=complete_system)
    ] = "razor-shwfs",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="File to write (default: standard output).")
    ] = None,
) -> None:
    """Write a new configuration: every key with its meaning, unit and range."""
    from escape_hw.config.templates import starter_text
    from escape_hw.io.storage import refuse_existing, write_atomic

    text = starter_text(name, base)
    context.set_subject(name, None, None)
    if out is None:
        context.show(text.rstrip("\n"))
        context.report(toml=text)
        return
    refuse_existing(out)
    write_atomic(out, text.encode())
    context.show(f"{out}: written; edit it, then: escape config check {out}")
    context.report(file=out)


@config_app.command("schema")
@command("config schema")
def schema(context: CommandContext) -> None:
    """Print the JSON schema of the system files, for editors."""
    from escape_hw.config.templates import json_schema

    context.json = True
    context.result(json_schema())
