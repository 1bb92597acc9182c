"""Fenced blocks of the documentation, and how each is tried."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[2]
#: The documentation's own pages, without those that its build writes.
EVERY = sorted(
    page for page in (ROOT / "docs").rglob("*.md") if not {"_build", "_generated"} & set(page.parts)
)


@dataclass(frozen=True)
class Block:
    """A fenced block: its language, the words behind it, its lines."""

    language: str
    marks: tuple[str, ...]
    text: str

    def commands(self) -> list[str]:
        """The lines of a shell block that call this package."""
        lines = (line.split("  #")[0].strip() for line in self.text.splitlines())
        return [line for line in lines if line.startswith("escape ")]


def blocks_of(page: Path) -> list[Block]:
    """Fenced blocks in the order in which they stand."""
    found = re.findall(r"^```([a-z]+)([^\n]*)\n(.*?)^```$", page.read_text(encoding="utf-8"), re.M | re.S)
    return [Block(language, tuple(marks.split()), text) for language, marks, text in found]


def call(words: list[str], folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a program in a folder that is also where the user's data go."""
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8", "XDG_DATA_HOME": str(folder / "data")}
    return subprocess.run(
        words, cwd=folder, capture_output=True, text=True, timeout=600, check=False, env=environment
    )


def escape(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of the command line."""
    program = [sys.executable, "-c", "from escape_hw.cli import main; main()"]
    return call([*program, *line.split()[1:]], folder)


def spelled_right(line: str) -> None:
    """Parse a line as the command line would, without running it; raises when it is wrong."""
    from typer.main import get_command

    from escape_hw.cli.app import app

    command: Any = get_command(app)
    words, context = line.split()[1:], None
    while hasattr(command, "resolve_command"):
        context = command.make_context(command.name, list(words), parent=context)
        _, command, words = command.resolve_command(context, words)
    command.make_context(command.name, list(words), parent=context)
