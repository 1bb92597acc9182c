"""The name that was probably meant, for messages about an unknown one."""

from __future__ import annotations

import difflib
from collections.abc import Iterable


def closest_match(word: str, choices: Iterable[str]) -> str | None:
    """The choice most similar to a word in upper or lower case, or ``None``."""
    by_lower_case = {choice.lower(): choice for choice in choices}
    found = difflib.get_close_matches(word.lower(), by_lower_case, n=1, cutoff=0.6)
    return by_lower_case[found[0]] if found else None


def did_you_mean(suggestion: str | None) -> str:
    """A suggestion as the end of a message; empty without one."""
    return f" (did you mean '{suggestion}'?)" if suggestion else ""
