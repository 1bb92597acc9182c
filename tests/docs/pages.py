"""Fenced blocks of the documentation, and how each is tried."""

from __future__ import annotations

import json
import os
import re
import shutil
import subprocess
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import preloaded
import pytest
from shared_products import make_once

ROOT = Path(__file__).parents[2]
#: The documentation's own pages, without those that its build writes.
EVERY = sorted(
    page for page in (ROOT / "docs").rglob("*.md") if not {"_build", "_generated"} & set(page.parts)
)


#: Longest that a command of a page may take, on a computer that does other work as well.
_LONGEST_S = 1800


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
    """Run a program in a folder that is also where the user's data go; Python has its imports."""
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8", "XDG_DATA_HOME": str(folder / "data")}
    if words[0] == sys.executable and words[1] != "-m":
        return preloaded.run(words[1:], environment, folder, _LONGEST_S)
    return subprocess.run(
        words, cwd=folder, capture_output=True, text=True, timeout=_LONGEST_S, check=False, env=environment
    )


def escape(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
    """Run a line of the command line."""
    return call([sys.executable, *line.split()[1:]], folder)


class Reader:
    """A reader who follows a page in an empty folder.

    A command whose result another reader has already, from the same commands before it, is not run again: its
    files and output are copied. All systems are simulated with a fixed seed, so the results are the same.

    Parameters
    ----------
    folder
        The empty folder.
    factory
        Of temporary folders; all workers share the results.
    """

    def __init__(self, folder: Path, factory: pytest.TempPathFactory) -> None:
        self.folder, self._factory = folder, factory
        #: What each folder that a command has written was made by: the command, and those of its inputs.
        self._made: dict[str, str] = {}

    def escape(self, line: str) -> subprocess.CompletedProcess[str]:
        """Run a line of the command line, or copy what it gave to another reader."""
        words = line.split()
        inputs = {part.split("/")[0] for part in words[1:] if (self.folder / part.split("/")[0]).exists()}
        known = "--out" in words and inputs <= set(self._made)
        if words[1] not in ("calibrate", "loop", "track") or not known:
            return escape(line, self.folder)
        name = words[words.index("--out") + 1]
        self._made[name] = json.dumps([line, {one: self._made[one] for one in sorted(inputs)}])

        def run(draft: Path) -> None:
            done = escape(line, self.folder)
            assert done.returncode == 0, f"{line}: {done.stderr}"
            shutil.copytree(self.folder / name, draft / "files")
            (draft / "out").write_text(done.stdout, encoding="utf-8")

        made = make_once(self._factory, self._made[name], run)
        if not (self.folder / name).exists():
            shutil.copytree(made / "files", self.folder / name)
        return subprocess.CompletedProcess(words, 0, (made / "out").read_text(encoding="utf-8"), "")


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
