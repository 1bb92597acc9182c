"""The study of imperfections states what its raw tables contain."""

from __future__ import annotations

import json
import re
import shlex
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "studies" / "nuisances.md").read_text()
COMMANDS = re.findall(r"^python (benchmarks/studies/nuisances\.py .*)$", PAGE, re.MULTILINE)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_page_has_what_the_command_prints(command, capsys, monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks" / "studies")
    for name in ("nuisances", "registration_errors", "realisation_tables"):
        monkeypatch.delitem(sys.modules, name, raising=False)
    import nuisances

    monkeypatch.setattr(nuisances, "run_realisation", None)
    monkeypatch.chdir(ROOT)
    monkeypatch.setattr(sys, "argv", shlex.split(command))
    nuisances.main()
    assert capsys.readouterr().out.rstrip() in PAGE


def test_the_realisations_are_those_of_this_study_and_of_one_commit():
    rows = [
        json.loads(line)
        for table in (ROOT / "docs" / "studies" / "nuisances").glob("*.jsonl")
        for line in table.read_text().splitlines()
    ]
    assert min(row["realisation"] for row in rows) == 2000
    assert len({row["commit"] for row in rows}) == 1
