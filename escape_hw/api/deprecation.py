"""Keywords of an earlier version, accepted for one release with a ``DeprecationWarning``."""

from __future__ import annotations

import functools
import warnings
from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")


def renamed_keywords(**renamed: str) -> Callable[[Callable[P, T]], Callable[P, T]]:
    """Accept keywords of version 0.1.0 under their former names; they will go with version 0.3.0.

    The signature of the decorated function stays that of the new names.

    Parameters
    ----------
    renamed
        Former name -> present name.
    """

    def decorate(function: Callable[P, T]) -> Callable[P, T]:
        @functools.wraps(function)
        def wrapper(*args: Any, **options: Any) -> T:
            for old in renamed.keys() & options.keys():
                new = renamed[old]
                warnings.warn(
                    f"{function.__name__}(): {old}= is called {new}= since version 0.2.0",
                    DeprecationWarning,
                    stacklevel=2,
                )
                if new in options:
                    raise TypeError(f"{function.__name__}(): {old}= and {new}= are the same; give one")
                options[new] = options.pop(old)
            return function(*args, **options)

        return wrapper

    return decorate
