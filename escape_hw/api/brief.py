"""Results in a few words, for the prompt and for logs: sizes instead of values."""

from __future__ import annotations

from collections.abc import Mapping, Sequence, Set
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np

#: Characters of a text, and values of a series, that are shown as they are.
_TEXT, _SERIES = 60, 6


def brief(one: Any) -> str:
    """A dataclass in one line: short values as they are, arrays by kind and shape, long ones by length.

    For classes that hold arrays: ``__repr__ = brief``.
    """
    parts = (f"{field.name}={said(getattr(one, field.name))}" for field in fields(one) if field.repr)
    return f"{type(one).__name__}({', '.join(parts)})"


def said(value: object) -> str:
    """A value in a few words."""
    if isinstance(value, np.ndarray):
        return f"{value.dtype}{list(value.shape)}"
    if isinstance(value, float):
        return f"{value:.6g}"
    if isinstance(value, str):
        return repr(value) if len(value) <= _TEXT else f"{len(value)} characters"
    if is_dataclass(value) and not isinstance(value, type):
        whole = repr(value)
        return whole if len(whole) <= _TEXT else f"{type(value).__name__}(...)"
    if isinstance(value, Mapping | Sequence | Set):
        whole = repr(value) if len(value) <= _SERIES else ""
        return whole if 0 < len(whole) <= _TEXT else f"{type(value).__name__} of {len(value)}"
    return repr(value)
