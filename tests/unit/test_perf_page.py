"""``escape perf --markdown``: the table goes between the marks, the prose stays."""

from __future__ import annotations

import json

import pytest

from escape_hw.api.benchmark import BenchmarkRow, product_rate
from escape_hw.cli.system.perf import BEGIN, END, measurement_conditions, render, require_page, write_page
from escape_hw.errors import ConfigError

ROWS = [
    BenchmarkRow("a: one", 2.0, 6.0, "peer 1.0", "ms", "lower", "with | bars", floor=1.0),
    BenchmarkRow("b: two", 3.0, None, "peer 2.0", "frame/s", "higher", "not installed"),
]


def test_the_table_replaces_what_stood_between_the_marks(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(f"# Title\n\nprose\n\n{BEGIN}\nold\n{END}\n\nmore prose\n")
    for _ in range(2):
        require_page(page)
        write_page(page, ROWS, measurement_conditions())
    text = page.read_text()
    assert text.startswith("# Title\n\nprose\n")
    assert text.endswith(f"{END}\n\nmore prose\n")
    assert "old" not in text
    assert text.count("| a: one | 2 | 6 | ms | 3.00 | 50% | peer 1.0 | with / bars |") == 1
    assert text.count("| b: two | 3 | - | frame/s | - | - | peer 2.0 | not installed |") == 1


def test_a_new_page_is_made_and_a_page_without_marks_refused(tmp_path):
    new = tmp_path / "new.md"
    require_page(new)
    write_page(new, ROWS, measurement_conditions())
    require_page(new)
    bare = tmp_path / "bare.md"
    bare.write_text("nothing\n")
    with pytest.raises(ConfigError, match="no place for the table"):
        require_page(bare)
    with pytest.raises(ConfigError, match="is no folder"):
        require_page(tmp_path / "missing" / "page.md")


def test_conditions_name_what_was_there_and_what_was_not():
    at = json.loads(json.dumps(measurement_conditions(), allow_nan=False))
    assert at["cores"] >= 1
    assert at["versions"]["numpy"]
    at["versions"]["specula"] = None
    assert "Not installed:" in render(ROWS, at)
    assert "specula None" not in render(ROWS, at)


def test_the_floor_is_a_share_at_most_one_both_ways():
    assert ROWS[0].reached == 0.5
    assert BenchmarkRow("c", 5.0, None, "", "frame/s", "higher", floor=10.0).reached == 0.5
    assert ROWS[1].reached is None
    assert product_rate(size=64) > 1e6
