"""The procedures as a server offers them: entries for clients, checks of arguments, requests."""

from __future__ import annotations

from dataclasses import replace
from functools import reduce
from typing import Any

from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError
from escape_hw.remote.state import Arguments, ProcedureEntry, ProcedureParameter
from escape_hw.runtime.procedures.calibration import CalibrationProcedure
from escape_hw.runtime.procedures.declaration import Parameter, ProcedureSpec, check_arguments, present_names
from escape_hw.runtime.procedures.registry import PROCEDURES, find_procedure
from escape_hw.server.engine.product_store import ProductStore


def offered_parameters(procedure: type[ProcedureSpec[Any]]) -> tuple[Parameter, ...]:
    """The parameters of a procedure that clients may set."""
    return tuple(one for one in procedure.parameters() if one.on_server)


class ProcedureRegistry:
    """The procedures that a server offers for its system.

    Parameters
    ----------
    config
        The system's configuration; it has the defaults of many parameters.
    """

    def __init__(self, config: SystemConfig) -> None:
        self._config = config

    @property
    def entries(self) -> tuple[ProcedureEntry, ...]:
        """Name, help and parameters of all procedures, for clients."""
        return tuple(
            ProcedureEntry(
                name=each.name, title=each.title, help=each.help,
                parameters=tuple(map(self._describe, offered_parameters(each))),
            )
            for each in PROCEDURES
        )  # fmt: skip

    def _describe(self, one: Parameter) -> ProcedureParameter:
        kind = {"run": "text", "choices": "text"}.get(one.kind, one.kind)
        choices = one.choices if kind == "choice" else ()
        return ProcedureParameter(
            name=one.name, kind=kind, default=self._default(one), unit=one.unit, help=one.help,
            label=one.label, choices=choices, low=one.low, high=one.high,
        )  # fmt: skip

    def _default(self, one: Parameter) -> Any:
        if one.default is not None or not one.config_key:
            return one.default
        value = reduce(getattr, one.config_key.split("."), self._config)
        return ",".join(value) if isinstance(value, tuple) else value

    def arguments(self, name: str, given: Arguments) -> Arguments:
        """All arguments of a procedure, defaults included.

        Raises
        ------
        ConfigError
            There is no such procedure, or an argument is wrong.
        """
        parameters = offered_parameters(find_procedure(name))
        values = check_arguments(map(_as_sent, parameters), given)
        defaults = {one.name: self._default(one) for one in parameters}
        return {key: defaults[key] if value is None else value for key, value in values.items()}

    def task(self, name: str, given: Arguments, product_store: ProductStore) -> ProcedureSpec[Any]:
        """The request for a run with these arguments.

        A resumed run keeps its own arguments and settings where none are given.

        Raises
        ------
        ConfigError, ProductError
            An argument is wrong, a matrix is unknown, or the run cannot be resumed.
        """
        procedure = find_procedure(name)
        parameters = offered_parameters(procedure)
        present = present_names(parameters, given)
        checked = check_arguments(map(_as_sent, parameters), present)
        arguments = {key: checked[key] for key, value in present.items() if value is not None}
        for one in parameters:
            value = arguments.get(one.name)
            if one.kind == "matrix" and value is not None:
                arguments[one.name] = product_store.matrix_path(value)
            elif one.kind == "matrix" and one.required:
                raise ConfigError(f"{one.name} is missing; name a matrix that the server holds")
            elif one.kind == "run" and value is not None:
                arguments[one.name] = product_store.readable_path(value)
        resume = arguments.get("resume")
        if resume is not None and issubclass(procedure, CalibrationProcedure):
            arguments = {**procedure.settings_of_run(resume), **arguments}
        return procedure.from_arguments(arguments)


def _as_sent(one: Parameter) -> Parameter:
    """The parameter as a client sends it: files are names or paths as text, and nothing is required."""
    return replace(one, kind="text" if one.kind in ("matrix", "run") else one.kind, required=False)


def needs_loop(name: str, arguments: Arguments) -> bool:
    """Whether a procedure works in closed loop, so that it cannot be paused between two frames."""
    return find_procedure(name).works_in_closed_loop(arguments)
