"""What a page says that a command prints, held against what it printed."""

from __future__ import annotations

import re

_NUMBER = re.compile(r"[+−-]?\d+(?:\.\d+)?")


def _words(line: str) -> str:
    """A line without its numbers."""
    return " ".join(_NUMBER.sub("#", line).split())


def _numbers(line: str) -> list[float]:
    return [float(text.replace("−", "-")) for text in _NUMBER.findall(line)]


def differences(quoted: str, printed: str) -> list[str]:
    """Lines of a quotation that the output does not have, or has with other numbers.

    A value with an error may be half of that error off, a difference over its error a half, other numbers
    two per cent: what another processor's rounding may do, and no other estimator.
    """
    found: dict[str, list[str]] = {}
    for line in printed.splitlines():
        found.setdefault(_words(line), []).append(line)
    wrong = []
    for line in filter(str.strip, quoted.splitlines()):
        same = found.get(_words(line), [])
        if not any(_agree(line, other) for other in same):
            wrong.append(f"{line!r} is quoted; printed: {same or 'nothing like it'}")
    return wrong


def _agree(quoted: str, printed: str) -> bool:
    error = re.search(r"±\s*([\d.]+)", printed)
    pairs = list(zip(_numbers(quoted), _numbers(printed), strict=True))
    if error is not None:
        (a, b), (sigma, other), *rest = pairs
        size = float(error[1])
        return abs(a - b) <= 0.5 * size and abs(sigma - other) <= 0.2 * size and _near(rest)
    return _near(pairs)


def _near(pairs: list[tuple[float, float]]) -> bool:
    return all(abs(a - b) <= max(0.5 if abs(b) < 10 else 0.0, 0.02 * abs(b)) for a, b in pairs)
