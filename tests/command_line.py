"""Fixtures that call the command line in this process."""

from __future__ import annotations

import json

import pytest

from escape_hw.cli import main


@pytest.fixture
def escape(capsys):
    """Run the command; returns exit code, standard output and standard error."""

    def call(*words: object) -> tuple[int, str, str]:
        capsys.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(word) for word in words])
        out, err = capsys.readouterr()
        return ended.value.code or 0, out, err

    return call


@pytest.fixture
def document(escape):
    """Run with ``--json``: exit code, the only document, standard error."""

    def call(*words: object) -> tuple[int, dict, str]:
        code, out, err = escape(*words, "--json")
        return code, json.loads(out, parse_constant=pytest.fail), err

    return call
