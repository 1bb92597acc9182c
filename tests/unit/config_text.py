"""Wrong configurations and their error messages."""

from __future__ import annotations

import pytest

from escape_hw.config.loader import load_text
from escape_hw.errors import ConfigError


def complaint(text: str, **options: object) -> list[str]:
    """The lines of what is said about a text that must be refused."""
    with pytest.raises(ConfigError) as caught:
        load_text(text, "bench.toml", **options)  # type: ignore[arg-type]
    return str(caught.value).splitlines()


def line_with(text: str, fragment: str) -> int:
    """Number of the first line that holds a fragment, from 1."""
    return next(n for n, line in enumerate(text.splitlines(), start=1) if fragment in line)
