"""Commands derived from the declarations of the procedures."""

from __future__ import annotations

import inspect
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.command import Command, build_command, keyword
from escape_hw.cli.context import CommandContext
from escape_hw.runtime.procedures.declaration import Parameter, ProcedureSpec
from escape_hw.runtime.procedures.python_method import describe

_TYPES: dict[str, Any] = {
    "int": int, "float": float, "bool": bool, "choice": str, "choices": str, "text": str,
    "matrix": Path, "matrices": list[Path], "run": Path,
}  # fmt: skip
_METAVARS = {"matrix": "FILE", "matrices": "FILE", "run": "RUN"}


def option_name(name: str) -> str:
    """The option of a parameter: ``--dropped-modes`` for ``dropped_modes``."""
    return f"--{name.replace('_', '-')}"


def procedure_options(parameters: Iterable[Parameter], optional: bool = False) -> list[inspect.Parameter]:
    """Typer's parameters for those of a procedure; options of earlier versions are hidden.

    With ``optional``, every option is ``None`` unless it is given, whatever its default.
    """
    found = []
    for one in parameters:
        default = None if optional or one.default == () else one.default
        found.append(keyword(one.name, _option(one), inspect.Parameter.empty if one.required else default))
        for old in (*one.deprecated, *one.deprecated_inverse):
            name = option_name(old)
            hidden = typer.Option(name, hidden=True)
            found.append(keyword(old, Annotated[_TYPES[one.kind] | None, hidden], None))
    return found


def _option(one: Parameter) -> Any:
    name = option_name(one.name)
    words = [f"{name}/--no-{name[2:]}"] if one.kind == "bool" else [name]
    low, high = one.low, one.high
    if one.kind == "int":
        low, high = (None if limit is None else int(limit) for limit in (low, high))
    metavar = "|".join(one.choices) if one.kind == "choice" else _METAVARS.get(one.kind)
    text = describe(replace(one, choices=() if one.kind == "choice" else one.choices))
    kind = _TYPES[one.kind]
    return Annotated[
        kind if one.required else kind | None,
        typer.Option(
            *words,
            help=text,
            metavar=metavar,
            show_default=one.kind != "bool" or bool(one.default),
            min=low,
            max=high,
        ),
    ]


def procedure_command(procedure: type[ProcedureSpec[Any]]) -> Command:
    """The command of a procedure, for ``typer.Typer.command``."""

    def run(
        context: CommandContext, selection: options.SystemSelection, out: Path | None, **arguments: Any
    ) -> None:
        context.run_procedure(procedure.from_arguments(arguments, option_name), selection, out)

    parameters = [
        keyword("selection", options.Selection),
        *procedure_options(procedure.parameters()),
        keyword("out", options.Out, None),
    ]
    return build_command(run, procedure.name, parameters, help=procedure.help, quiet=True)
