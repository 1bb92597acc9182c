"""Campaigns over realisations are resumed, and other settings are kept separate."""

from __future__ import annotations

import importlib.util
import json
from pathlib import Path

import pytest

_FILE = Path(__file__).parents[2] / "benchmarks" / "studies" / "realisation_tables.py"


@pytest.fixture(scope="module")
def tables():
    spec = importlib.util.spec_from_file_location("realisation_tables", _FILE)
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def test_realisations_that_the_file_has_are_not_measured_again(tables, tmp_path):
    target, measured = tmp_path / "new" / "lines.jsonl", []

    def measure(number):
        measured.append(number)
        return {"error": 0.5 * number}

    tables.each_realisation(target, {"frames": (20, 50)}, range(2), measure)
    lines = tables.each_realisation(target, {"frames": (20, 50)}, [1, 3], measure)
    assert measured == [0, 1, 3]
    assert [line["error"] for line in lines] == [0.0, 0.5, 1.5]
    assert [json.loads(line)["realisation"] for line in target.read_text().splitlines()] == [0, 1, 3]


def test_realisations_of_other_settings_are_not_mixed_with_these(tables, tmp_path):
    target = tmp_path / "lines.jsonl"
    tables.each_realisation(target, {"frames": 20}, [0], lambda number: {})
    before = target.read_bytes()
    with pytest.raises(SystemExit, match=r"lines\.jsonl has realisations with other settings"):
        tables.each_realisation(target, {"frames": 50}, [1], lambda number: {})
    assert target.read_bytes() == before
