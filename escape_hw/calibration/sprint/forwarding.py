"""Objects with some members of their own and all others of another object."""

from __future__ import annotations

from functools import lru_cache
from typing import Any, Self


class Forwarding:
    """An object with members of its own, and all other public ones of another object.

    ``isinstance`` looks for the members of a protocol in the class since Python 3.12, so that a
    ``__getattr__`` does not make an object an instance of one. This one is an instance of all protocols that
    the original is an instance of.

    Parameters
    ----------
    original
        The other object.
    """

    def __new__(cls, original: object, *more: object) -> Self:
        """Make an instance of a subclass with the members that the class lacks."""
        names = frozenset(name for name in dir(original) if name[0] != "_" and not hasattr(cls, name))
        made: Self = object.__new__(_with_members(cls, names))  # type: ignore[arg-type]
        return made

    def __init__(self, original: Any) -> None:
        self.original = original

    def passed_on(self, name: str) -> Any:
        """A member that the class itself lacks."""
        return getattr(self.original, name)

    def __getattr__(self, name: str) -> Any:
        # For type checkers: what the original lacks is missing here, too.
        raise AttributeError(f"{type(self).__name__!r} object has no attribute {name!r}", name=name, obj=self)


@lru_cache
def _with_members(cls: Any, names: frozenset[str]) -> type[Any]:
    def member(name: str) -> property:
        return property(lambda self: self.passed_on(name))

    members = {name: member(name) for name in names}
    return type(cls.__name__, (cls,), {"__module__": cls.__module__, **members})
