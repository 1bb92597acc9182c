"""Factories that other packages offer, held to what is expected of them before anything opens."""

from __future__ import annotations

import inspect
import traceback
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, TypeVar

from escape_hw.errors import ConfigError, EscapeError

T = TypeVar("T")


def require_factory(what: str, where: str, factory: object, parameters: Sequence[str]) -> None:
    """Refuse what cannot be called as a factory is.

    Parameters
    ----------
    what, where
        Of whom it is, and where it was found.
    factory
        What was found.
    parameters
        What it is called with, in this order.

    Raises
    ------
    ConfigError
        It is not callable, or takes other arguments.
    """
    call = f"factory({', '.join(parameters)})"
    if not callable(factory):
        raise ConfigError(
            f"{what} is broken: {where} is not callable (it is of type {type(factory).__name__}); {call} is "
            "expected"
        )
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):
        # Some compiled functions do not tell; calling them will.
        return
    try:
        signature.bind(*parameters)
    except TypeError as error:
        raise ConfigError(
            f"{what} is broken: {where} takes {signature} ({error}); it is called as {call}"
        ) from error


def made(what: str, kind: type[T], factory: Callable[..., object], *arguments: Any) -> T:
    """What a factory makes, if it is of the right kind.

    Parameters
    ----------
    what
        Of whom it is.
    kind
        What it must make.
    factory, arguments
        Called with these.

    Raises
    ------
    ConfigError
        It fails, or makes something else.
    EscapeError
        The factory's own.
    """
    try:
        one = factory(*arguments)
    except EscapeError:
        raise
    except Exception as error:
        raise ConfigError(
            f"{what} cannot be made: {_name(factory)} failed with {type(error).__name__}: {error}"
            f"{_place(error)}"
        ) from error
    if not isinstance(one, kind):
        raise ConfigError(
            f"{what} makes a {type(one).__name__}, not a {kind.__name__}; {_name(factory)} must return one"
        )
    return one


def _name(factory: object) -> str:
    module, name = (getattr(factory, key, "") for key in ("__module__", "__qualname__"))
    return f"{module}:{name}" if module and name else repr(factory)


def _place(error: Exception) -> str:
    """Where it was raised, for its author."""
    frames = traceback.extract_tb(error.__traceback__)
    return f" ({Path(frames[-1].filename).name}, line {frames[-1].lineno})" if frames else ""
