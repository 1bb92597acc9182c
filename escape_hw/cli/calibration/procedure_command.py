"""Commands derived from the declarations of the procedures."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.calibration.display import display_function
from escape_hw.cli.context import command_context
from escape_hw.runtime.procedures.declaration import Parameter, ProcedureSpec
from escape_hw.runtime.procedures.python_method import describe

_TYPES: dict[str, Any] = {
    "int": int, "float": float, "bool": bool, "choice": str, "choices": str, "text": str,
    "matrix": Path, "matrices": list[Path], "run": Path,
}  # fmt: skip
_METAVARS = {"matrix": "FILE", "matrices": "FILE", "run": "RUN"}
#: Options of every procedure's command.
COMMON = {
    "out": options.Out, "set": options.Set, "seed": options.Seed, "mode": options.Mode,
    "json": options.Json, "quiet": options.Quiet,
}  # fmt: skip


def option_name(name: str) -> str:
    """The option of a parameter: ``--dropped-modes`` for ``dropped_modes``."""
    return f"--{name.replace('_', '-')}"


def procedure_options(parameters: Iterable[Parameter], optional: bool = False) -> list[inspect.Parameter]:
    """Typer's parameters for those of a procedure; options of earlier versions are hidden.

    Parameters
    ----------
    parameters
        The declared parameters.
    optional
        Every option is ``None`` unless it is given, whatever its default.
    """
    found = []
    for one in parameters:
        default = None if optional or one.default == () else one.default
        found.append(_keyword(one.name, _option(one), inspect.Parameter.empty if one.required else default))
        for old in (*one.deprecated, *one.deprecated_inverse):
            name = option_name(old)
            hidden = typer.Option(name, hidden=True)
            found.append(_keyword(old, Annotated[_TYPES[one.kind] | None, hidden], None))
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


def _keyword(name: str, annotation: Any, default: Any) -> inspect.Parameter:
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def with_signature(
    command: Callable[[dict[str, Any]], None], parameters: Sequence[inspect.Parameter], name: str, help: str
) -> Callable[..., None]:
    """A function with these parameters, as Typer reads them, that passes its arguments on by name."""

    def wrapper(**arguments: Any) -> None:
        command(arguments)

    common = [
        _keyword(key, annotation, False if key in ("json", "quiet") else None)
        for key, annotation in COMMON.items()
    ]
    wrapper.__name__, wrapper.__doc__ = name.replace("-", "_"), help
    wrapper.__signature__ = inspect.Signature([*parameters, *common])  # type: ignore[attr-defined]
    wrapper.__annotations__ = {one.name: one.annotation for one in (*parameters, *common)}
    return wrapper


def split_common(arguments: Mapping[str, Any]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Arguments of the procedure, and those of every command."""
    own = {key: value for key, value in arguments.items() if key not in COMMON and key != "system"}
    return own, {key: arguments[key] for key in COMMON}


def procedure_command(procedure: type[ProcedureSpec[Any]]) -> Callable[..., None]:
    """The command of a procedure, for ``typer.Typer.command``."""

    def command(arguments: dict[str, Any]) -> None:
        own, common = split_common(arguments)
        with command_context(procedure.name, json=common["json"], quiet=common["quiet"]) as context:
            request = procedure.from_arguments(own, option_name)
            selection = options.SystemSelection.of(
                arguments["system"], common["set"], common["seed"], common["mode"]
            )
            context.run_procedure(request, selection, common["out"], display_function(procedure.name))

    parameters = [
        _keyword("system", options.System, inspect.Parameter.empty),
        *procedure_options(procedure.parameters()),
    ]
    return with_signature(command, parameters, procedure.name, procedure.help)
