"""``escape track`` shows its last registration beside what a twin hides."""

from __future__ import annotations

import io
from types import SimpleNamespace

import pytest
from rich.console import Console

from escape_hw.api.registration import PARAMETERS
from escape_hw.api.tracking import TrackResult
from escape_hw.cli.track import _show
from escape_hw.io.track_document import track_document

PLANTED = {
    "shift_x": -16.0,
    "shift_y": -71.0,
    "rotation": -0.77,
    "radial_scaling": 2.9,
    "tangential_scaling": 0.0,
}


def shown(result: TrackResult, planted: dict[str, float] | None) -> str:
    console = Console(file=io.StringIO(), width=120)
    document = {**track_document(result), "planted_end": planted, "products": {}}
    one = SimpleNamespace(show=lambda *what: [console.print(item) for item in what])
    _show(one, result, SimpleNamespace(simulated=planted is not None), document)  # type: ignore[arg-type]
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def track() -> TrackResult:
    result = TrackResult()
    for second in (1.0, 2.0):
        values = {name: PLANTED[name] + 0.2 for name in PARAMETERS}
        result.add(
            seconds=second, residual_nm=50.0, **values, **{f"{name}_sigma": 0.1 for name in PARAMETERS}
        )
    return result


@pytest.mark.parametrize("planted", [PLANTED, None])
def test_the_registration_stands_beside_the_planted_one(planted: dict[str, float] | None) -> None:
    text = shown(track(), planted)
    (row,) = [line.split() for line in text.splitlines() if "Shift X" in line]
    assert row[row.index("±") - 1 : row.index("±") + 2] == ["−15.80", "±", "0.10"]
    assert ("planted" in text) == (planted is not None)
    if planted is not None:
        assert row[-2:] == ["+2.0", "−16"]


def test_a_track_without_a_row_shows_no_table() -> None:
    assert "Shift X" not in shown(TrackResult(), {})
