"""``escape systems`` and ``escape config``."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.session import session

if TYPE_CHECKING:
    from escape_hw.config.models import SystemConfig

config_app = typer.Typer(help="Check, start and describe configurations.", no_args_is_help=True)


def systems(json: options.Json = False) -> None:
    """List the systems that come with the package."""
    with session("systems", json=json) as one:
        from escape_hw.cli.views import rich_table
        from escape_hw.config.bundled import bundled_systems
        from escape_hw.config.load import load_system
        from escape_hw.io.documents import head
        from escape_hw.report.tables import Table

        rows = [_about(load_system(name)) for name in bundled_systems()]
        headings = ("system", "mode", "actuators", "modes", "description")
        keys = ("name", "mode", "n_act", "n_modes", "description")
        cells = tuple(tuple(str(row[key]) for key in keys) for row in rows)
        one.show(rich_table(Table(headings, cells, numeric=False)))
        one.result({**head("systems", None, None, None), "systems": rows})


def _about(config: SystemConfig) -> dict[str, Any]:
    return {
        "name": config.system.name,
        "description": config.system.description,
        "mode": config.system.mode,
        "sensor": config.sensor.kind,
        "n_act": config.devices.dm.n_act,
        "n_modes": config.basis.n_modes,
    }


@config_app.command("check")
def check(
    file: Annotated[str, typer.Argument(help="TOML file, or the name of a system.")],
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Check a configuration; tells every mistake at once with file, line, key and allowed range."""
    with session("config check", json=json) as one:
        from escape_hw.io.documents import head

        config = one.configured(options.Choice.of(file, set, seed, mode))
        one.show(f"{file}: sound ({config.system.name}, mode {config.system.mode})")
        document = head("config check", config.system.name, config.simulated, config.system.seed)
        one.result({**document, "file": file, "valid": True})


@config_app.command("init")
def init(
    name: Annotated[str, typer.Argument(help="Name of the new system.")] = "my-system",
    base: Annotated[str, typer.Option("--base", help="System whose values it starts with.")] = "razor-shwfs",
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="File to write (default: standard output).")
    ] = None,
    json: options.Json = False,
) -> None:
    """Start a configuration: every key with what it means, its unit and its range."""
    with session("config init", json=json) as one:
        from escape_hw.config.starter import starter_text
        from escape_hw.errors import ConfigError
        from escape_hw.io.documents import head
        from escape_hw.io.storage import write_atomic

        text = starter_text(name, base)
        document = head("config init", name, None, None)
        if out is None:
            one.show(text.rstrip("\n"))
            one.result({**document, "toml": text})
            return
        if out.exists():
            raise ConfigError(f"{out}: exists already; choose another name or remove it first")
        write_atomic(out, text.encode())
        one.show(f"{out}: written; edit it, then: escape config check {out}")
        one.result({**document, "file": out})


@config_app.command("schema")
def schema(json: options.Json = False) -> None:
    """Print the JSON schema of the system files, for editors that check while you type."""
    # The schema is one JSON document in any case.
    with session("config schema", json=True) as one:
        from escape_hw.config.schema import json_schema

        one.result(json_schema())
