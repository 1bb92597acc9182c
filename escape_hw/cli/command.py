"""Commands as functions of their context and system, with the options that all commands share."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Iterable
from typing import Annotated, Any, get_args

from typer.core import TyperGroup

from escape_hw.cli import options
from escape_hw.cli.context import command_context

Command = Callable[..., None]
_SELECTION: dict[str, Any] = {"set": options.Set, "seed": options.Seed, "mode": options.Mode}
_DEVICE: dict[str, Any] = {"driver": options.Driver, "serial": options.Serial}


class CommandGroup(TyperGroup):
    """Commands whose names are suggested for words in capitals, too."""

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the command of the first word; raises a usage error if there is none."""
        word, name = args[0], args[0].lower()
        if word not in self.commands and name in self.commands:
            ctx.fail(f"No such command '{word}'. Did you mean '{name}'?")
        return super().resolve_command(ctx, args)


def command(name: str, *, quiet: bool = False, without: tuple[str, ...] = ()) -> Callable[[Command], Command]:
    """Decorator that makes a command of a function; for ``typer.Typer.command``.

    The parameter ``context`` gets the :class:`CommandContext`, whose JSON document ``--json`` prints. A
    parameter ``selection``, see :data:`~escape_hw.cli.options.Selection`, gets the system named on the
    command line, with the changes by ``--set``, ``--seed`` and ``--mode``.

    Parameters
    ----------
    name
        Name of the command in its document.
    quiet
        Whether it shows progress, and therefore has the option ``--quiet``.
    without
        Names among ``set``, ``seed`` and ``mode`` that the command does not have.
    """

    def decorate(function: Command) -> Command:
        _, *parameters = inspect.signature(function, eval_str=True).parameters.values()
        return build_command(function, name, parameters, quiet=quiet, without=without)

    return decorate


def build_command(
    function: Command,
    name: str,
    parameters: Iterable[inspect.Parameter],
    *,
    help: str | None = None,
    quiet: bool = False,
    without: tuple[str, ...] = (),
) -> Command:
    """The command of a function with these parameters beside ``context``; see :func:`command`."""
    declared, selection = [], None
    for one in parameters:
        if one.name == "selection":
            selection = one
            declared.append(_system(one))
        else:
            declared.append(keyword(one.name, one.annotation, one.default))
    if selection is not None:
        choices = _SELECTION | (_DEVICE if selection.annotation == options.DeviceSelection else {})
        declared += [keyword(key, kind, None) for key, kind in choices.items() if key not in without]
    declared.append(keyword("json", options.Json, False))
    if quiet:
        declared.append(keyword("quiet", options.Quiet, False))

    def wrapper(**values: Any) -> None:
        given = {key: values.pop(key, None) for key in ("json", "quiet")}
        with command_context(name, json=bool(given["json"]), quiet=bool(given["quiet"])) as context:
            if selection is not None:
                changes, seed, mode = (values.pop(key, None) for key in _SELECTION)
                driver, serial = (values.pop(key, None) or "" for key in _DEVICE)
                system = values.pop("system") or ""
                values["selection"] = options.SystemSelection(
                    system, tuple(changes or ()), seed, mode, driver, serial
                )
            function(context, **values)

    wrapper.__name__, wrapper.__doc__ = name.replace("-", "_"), help or function.__doc__
    wrapper.__signature__ = inspect.Signature(declared)  # type: ignore[attr-defined]
    wrapper.__annotations__ = {one.name: one.annotation for one in declared}
    return wrapper


def keyword(name: str, annotation: Any, default: Any = inspect.Parameter.empty) -> inspect.Parameter:
    """A parameter as Typer reads it."""
    return inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=annotation)


def _system(selection: inspect.Parameter) -> inspect.Parameter:
    """The argument or option that names the system."""
    _, declared = get_args(selection.annotation)
    if selection.default is inspect.Parameter.empty:
        return keyword("system", Annotated[str, declared])
    return keyword("system", Annotated[str | None, declared], selection.default.system or None)
