"""Python methods that take names, help and earlier names of their parameters from declared procedures."""

from __future__ import annotations

import functools
import inspect
import textwrap
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

from escape_hw.deprecation import renamed_text, warn_renamed
from escape_hw.runtime.procedures.declaration import Parameter, ProcedureSpec, present_names

P = ParamSpec("P")
T = TypeVar("T")
_PROGRESS = Parameter("progress", "bool", False, help="Show a bar with the time left.")


def procedure_method(
    *procedures: type[ProcedureSpec[Any]], renamed: Mapping[str, str] | None = None
) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Decorate a method that runs one of these procedures.

    Parameters with a declared name are documented by the declaration (of the first procedure that has one)
    and accept the names of earlier versions. The others exist in Python only, with earlier names in
    ``renamed``, old -> new; ``progress`` shows a bar.
    """
    declared: dict[str, Parameter] = {}
    for procedure in procedures:
        for one in procedure.parameters():
            declared.setdefault(one.name, one)

    def decorate(method: Callable[P, T]) -> Callable[P, T]:
        own = [declared[name] for name in inspect.signature(method).parameters if name in declared]

        @functools.wraps(method)
        def wrapper(*args: P.args, **kwargs: P.kwargs) -> T:
            present = present_names(own, kwargs)
            for old, new in (renamed or {}).items():
                if old in present:
                    warn_renamed(renamed_text(old, new))
                    present[new] = present.pop(old)
            return method(*args, **present)

        wrapper.__doc__ = _with_parameters(inspect.getdoc(method), [*own, _PROGRESS])
        return wrapper

    return decorate


def _with_parameters(doc: str | None, parameters: list[Parameter]) -> str | None:
    """The docstring with these parameters at the end of its section "Parameters", before "Returns"."""
    if doc is None:
        return doc
    heading = "Parameters\n----------\n"
    before, _, after = doc.partition("Returns\n-------\n")
    entries = "".join(
        f"{one.name}\n{textwrap.fill(describe(one), 106, initial_indent='    ', subsequent_indent='    ')}\n"
        for one in parameters
    )
    section = before.rstrip() + ("\n" if heading in before else f"\n\n{heading}") + entries
    return f"{section}\nReturns\n-------\n{after}"


def describe(one: Parameter) -> str:
    """Help of a parameter with unit, choices and a default that the signature does not show."""
    is_clear = one.unit in one.help or one.unit == "frame"
    text = one.help if is_clear else f"{one.help.removesuffix('.')} ({one.unit})."
    if one.choices:
        text += f" One of {', '.join(one.choices)}."
    return f"{text} As configured by default." if one.config_key and one.default is None else text
