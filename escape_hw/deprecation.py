"""Deprecation messages for names, configuration keys and values of an earlier version."""

from __future__ import annotations

import functools
import sys
import warnings
from collections.abc import Callable, Mapping
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")
T = TypeVar("T", bound=type)

_PACKAGES = ("escape_hw", "escape_gui", "escape_drivers", "escape_sim")
#: Version with the new names, and the version in which the old ones are removed.
_SINCE, _REMOVED_IN = "0.2.0", "0.3.0"


class RenamedWarning(DeprecationWarning):
    """An old name was used; the command line prints these on standard error."""


def renamed_text(old: str, new: str) -> str:
    """Message for an old name that is still accepted."""
    return f"{old} is called {new} since version {_SINCE}; version {_REMOVED_IN} removes the old name"


def warn_renamed(message: str) -> None:
    """Issue a :class:`RenamedWarning`, attributed to the first caller outside ESCAPE's packages.

    Python hides deprecation warnings that are attributed to a library.
    """
    level, frame = 1, sys._getframe()  # noqa: SLF001
    while frame.f_back is not None and frame.f_globals.get("__name__", "").partition(".")[0] in _PACKAGES:
        level, frame = level + 1, frame.f_back
    warnings.warn(message, RenamedWarning, stacklevel=level)


def renamed_attributes(module: str, names: Mapping[str, str]) -> Callable[[str], Any]:
    """A ``__getattr__`` for a module that serves old names, with a :class:`RenamedWarning`.

    ``module`` is its ``__name__``; ``names`` maps old names to present ones in the same module.
    """

    def __getattr__(name: str) -> Any:
        if name not in names:
            raise AttributeError(f"module {module!r} has no attribute {name!r}")
        warn_renamed(renamed_text(f"{module}.{name}", f"{module}.{names[name]}"))
        return getattr(sys.modules[module], names[name])

    return __getattr__


def renamed_members(**names: str) -> Callable[[T], T]:
    """Class decorator that keeps old names, ``old="present"``, of members, with a :class:`RenamedWarning`."""

    def decorate(owner: T) -> T:
        for old, new in names.items():
            setattr(owner, old, _member_alias(owner.__name__, old, new))
        return owner

    return decorate


def _member_alias(owner: str, old: str, new: str) -> property:
    message = renamed_text(f"{owner}.{old}", f"{owner}.{new}")

    def read(instance: Any) -> Any:
        warn_renamed(message)
        return getattr(instance, new)

    def write(instance: Any, value: Any) -> None:
        warn_renamed(message)
        setattr(instance, new, value)

    return property(read, write, doc=f"Old name of :attr:`{new}`.")


def renamed_keywords(**renamed: str) -> Callable[[Callable[P, R]], Callable[P, R]]:
    """Decorator that accepts old names, ``old="present"``, of keywords, with a :class:`RenamedWarning`.

    The signature of the decorated function stays that of the present names.
    """

    def decorate(function: Callable[P, R]) -> Callable[P, R]:
        @functools.wraps(function)
        def wrapper(*args: Any, **options: Any) -> R:
            for old in renamed.keys() & options.keys():
                new = renamed[old]
                warn_renamed(renamed_text(f"{function.__name__}({old}=)", f"{function.__name__}({new}=)"))
                if new in options:
                    raise TypeError(f"{function.__name__}(): {old}= and {new}= are the same; give one")
                options[new] = options.pop(old)
            return function(*args, **options)

        return wrapper

    return decorate
