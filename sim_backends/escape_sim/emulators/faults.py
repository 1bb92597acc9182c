"""Scripts of faults of the emulators, and the option words of version 0.1.0."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping

from escape_hw.errors import ConfigError


def current_word(word: str, renamed: Mapping[str, str]) -> str:
    """Replace a word of version 0.1.0 by the present one and say so on standard error."""
    if word not in renamed:
        return word
    print(f"deprecated: {word!r} is now {renamed[word]!r}; the old word will be removed", file=sys.stderr)
    return renamed[word]


def split_fault_script(script: str) -> Iterator[tuple[str, int]]:
    """Split ``close@3,truncate@40`` into faults and the numbers of requests, counted from 0.

    Raises
    ------
    ConfigError
        The script has another form.
    """
    for part in filter(None, script.split(",")):
        fault, _, number = part.strip().partition("@")
        if not number.isdigit():
            raise ConfigError(f"fault {part!r}: write KIND@NUMBER, where NUMBER counts requests from 0")
        yield fault, int(number)
