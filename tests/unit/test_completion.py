"""What a shell offers for the beginning of a system's or driver's name."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from escape_hw.cli.app import app


def offered(line: str) -> list[str]:
    """The completions that bash gets for the last word of a command line."""
    environment = {
        "_ESCAPE_COMPLETE": "complete_bash", "COMP_WORDS": line, "COMP_CWORD": str(len(line.split(" ")) - 1),
    }  # fmt: skip
    return CliRunner().invoke(app, [], prog_name="escape", env=environment).output.split()


@pytest.mark.parametrize(
    "before", ["calibrate", "dm flat", "sweep", "config check", "config init --base", "doctor"]
)
def test_systems_are_offered(before: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert offered(f"escape {before} razor") == ["razor-pywfs", "razor-shwfs"]


def test_a_path_is_continued_to_folders_and_toml_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine").mkdir()
    for name in ("bench.toml", "bench.fits", ".hidden.toml"):
        (tmp_path / "mine" / name).touch()
    assert offered("escape calibrate mi") == ["mine/"]
    assert offered("escape calibrate mine/") == ["mine/bench.toml"]
    assert offered("escape calibrate mine/be") == ["mine/bench.toml"]
    assert offered("escape calibrate nowhere/be") == []


def test_drivers_of_real_devices_are_offered() -> None:
    assert offered("escape dm flat --driver a") == ["alpao", "asm"]
    assert offered("escape asm status --driver a") == ["asm"]
    assert offered("escape camera snap --driver a") == ["aravis"]
    assert offered("escape modulator start --driver ") == ["pi-e727"]
    assert offered("escape dm flat --driver sim") == []
