"""The command line."""

from __future__ import annotations

from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> None:
    """Run ``escape``; ends the process with the command's exit code."""
    from escape_hw.cli.app import run

    run(arguments)
