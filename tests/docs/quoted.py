"""The output quoted on a page, compared with the output of the command."""

from __future__ import annotations

import re

_NUMBER = re.compile(r"[+−-]?\d+(?:\.\d+)?")
_MEASURED = re.compile(rf"({_NUMBER.pattern})\s*±\s*({_NUMBER.pattern})")
#: Rounding decides which step is the last.
_ITERATIONS = re.compile(r"(\d+) iterations")


def _words(line: str) -> str:
    """A line without its numbers."""
    return " ".join(_NUMBER.sub("#", line).split())


def _value(text: str) -> float:
    return float(text.replace("−", "-"))


def differences(quoted: str, printed: str) -> list[str]:
    """Lines of a quotation that the output does not have, or has with other numbers.

    A value with an error may be half of that error off, a difference over its error a half, other numbers
    two per cent or one of their last digit, a number of iterations two: what another processor's rounding may
    do, and no other estimator.
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
    steps = zip(*(map(int, _ITERATIONS.findall(line)) for line in (quoted, printed)), strict=True)
    if any(abs(a - b) > 2 for a, b in steps):
        return False
    quoted, printed = (_ITERATIONS.sub("", line) for line in (quoted, printed))
    measured = zip(_MEASURED.findall(quoted), _MEASURED.findall(printed), strict=True)
    rest = zip(*(_NUMBER.findall(_MEASURED.sub("", line)) for line in (quoted, printed)), strict=True)
    return all(_same_measured(a, b) for a, b in measured) and all(_near(a, b) for a, b in rest)


def _same_measured(quoted: tuple[str, str], printed: tuple[str, str]) -> bool:
    (a, sigma), (b, other) = ((_value(value), _value(error)) for value, error in (quoted, printed))
    return abs(a - b) <= 0.5 * other and abs(sigma - other) <= 0.2 * other


def _near(quoted: str, printed: str) -> bool:
    a, b = _value(quoted), _value(printed)
    # What carries a sign is a difference in units of its error.
    if printed[0] in "+−":
        return abs(a - b) <= 0.5
    # A whole number is a count, which rounding does not change.
    places = max(len(text.partition(".")[2]) for text in (quoted, printed))
    last_digit = 10.0**-places if places else 0.0
    return abs(a - b) <= max(0.02 * abs(b), 1.001 * last_digit)
