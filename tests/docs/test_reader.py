"""Readers share the results of the same commands after the same commands, and of no others."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pages
import pytest


def test_readers_share_what_the_same_commands_give(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, tmp_path_factory: pytest.TempPathFactory
) -> None:
    ran: list[str] = []

    def write(line: str, folder: Path) -> subprocess.CompletedProcess[str]:
        ran.append(line)
        words = line.split()
        if "--out" in words:
            out = folder / words[-1]
            out.mkdir()
            (out / "im.fits").write_text(str(len(ran)))
        return subprocess.CompletedProcess(words, 0, f"{line}\n", "")

    monkeypatch.setattr(pages, "escape", write)
    system = f"system-{tmp_path.name}"
    first, closed = (
        f"escape calibrate {system} --out first",
        f"escape loop {system} --im first/im.fits --out c",
    )
    other = f"escape calibrate {system} --frames 9 --out first"
    folders = [tmp_path / name for name in "abc"]
    for folder, lines in zip(
        folders, [(first, closed), (first, "escape show first", closed), (other, closed)], strict=True
    ):
        folder.mkdir()
        reader = pages.Reader(folder, tmp_path_factory)
        assert [reader.escape(line).stdout for line in lines] == [f"{line}\n" for line in lines]
    # The third reader's loop has another matrix than that of the others.
    assert ran == [first, closed, "escape show first", other, closed]
    assert [(folder / "c" / "im.fits").read_text() for folder in folders] == ["2", "2", "5"]
