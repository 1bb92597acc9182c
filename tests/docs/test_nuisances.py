"""The study of imperfections states what its raw tables contain."""

from __future__ import annotations

import json
import re
import shlex
import sys

import pytest
from pages import ROOT

PAGE = (ROOT / "docs" / "studies" / "nuisances.md").read_text()
COMMANDS = re.findall(r"^python (benchmarks/studies/registration/nuisances\.py .*)$", PAGE, re.MULTILINE)


@pytest.mark.parametrize("command", COMMANDS)
def test_the_page_has_what_the_command_prints(command, capsys, monkeypatch, import_study):
    nuisances = import_study("registration/nuisances.py")
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
