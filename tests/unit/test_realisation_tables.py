"""Campaigns over realisations are resumed, and other settings are kept separate."""

from __future__ import annotations

import json

import pytest

from escape_benchmarks.realisation_tables import each_realisation


def test_realisations_that_the_file_has_are_not_measured_again(tmp_path):
    target, measured = tmp_path / "new" / "lines.jsonl", []

    def measure(number):
        measured.append(number)
        return {"error": 0.5 * number}

    each_realisation(target, {"frames": (20, 50)}, range(2), measure)
    lines = each_realisation(target, {"frames": (20, 50)}, [1, 3], measure)
    assert measured == [0, 1, 3]
    assert [line["error"] for line in lines] == [0.0, 0.5, 1.5]
    assert [json.loads(line)["realisation"] for line in target.read_text().splitlines()] == [0, 1, 3]


def test_realisations_of_other_settings_are_not_mixed_with_these(tmp_path):
    target = tmp_path / "lines.jsonl"
    each_realisation(target, {"frames": 20}, [0], lambda number: {})
    before = target.read_bytes()
    with pytest.raises(SystemExit, match=r"lines\.jsonl has realisations with other settings"):
        each_realisation(target, {"frames": 50}, [1], lambda number: {})
    assert target.read_bytes() == before
