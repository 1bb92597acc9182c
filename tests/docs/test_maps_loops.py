"""The page on the loops of MAPS states what its raw tables contain."""

from __future__ import annotations

import json
import re
from pathlib import Path

import numpy as np
import pytest

from escape_hw.pipeline.statistics import mean_interval

STUDIES = Path(__file__).parents[2] / "docs" / "studies"
ROW = re.compile(r"^\|.*\[table\]\(paired-loops/(?P<table>[\w-]+)\.md\)\) \| (?P<cells>.*) \|$", re.MULTILINE)
ROWS = {found["table"]: found["cells"] for found in ROW.finditer((STUDIES / "maps-loops.md").read_text())}
NAMES = ("ESCAPE + OG", "DO-CRIME + OG", "DO-CRIME")


def test_the_page_has_both_systems_clean_and_contaminated():
    assert set(ROWS) == {f"maps-{band}-{pupil}" for band in ("nir", "vis") for pupil in ("paired", "clean")}


@pytest.mark.parametrize("table", ROWS)
def test_the_page_states_the_means_and_the_interval(table):
    lines = [
        json.loads(line) for line in (STUDIES / "paired-loops" / f"{table}.jsonl").read_text().splitlines()
    ]
    values = {name: np.array([line["strehl"][name] for line in lines]) for name in NAMES}
    found = [float(number) for number in re.findall(r"[+-]?\d+\.\d+", ROWS[table])]
    difference = mean_interval(values["ESCAPE + OG"] - values["DO-CRIME"])
    expected = [float(one.mean()) for one in values.values()]
    expected += [difference.mean, difference.low, difference.high]
    assert found == pytest.approx(expected, abs=0.0501)
    # Not worse than DO-CRIME by more than half a per cent.
    assert difference.low > -0.5
