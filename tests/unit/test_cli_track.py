"""``escape track`` shows its last registration with the true one of a twin."""

from __future__ import annotations

import io

import pytest
from rich.console import Console

from escape_hw.api.registration import PARAMETERS, Registration
from escape_hw.api.tracking import TrackResult
from escape_hw.cli.calibration.display import format_result
from escape_hw.config.loader import load_system
from escape_hw.io.documents import track_document
from escape_hw.runtime.procedures.track import INJECTED_UNKNOWN, injected_registration

INJECTED = {
    "shift_x": -16.0,
    "shift_y": -71.0,
    "rotation": -0.77,
    "radial_scaling": 2.9,
    "tangential_scaling": 0.0,
}


def shown(result: TrackResult, injected: dict[str, float] | None, note: str = "") -> str:
    console = Console(file=io.StringIO(), width=120)
    document = {
        **track_document(result), "injected_end": injected, "injected_note": note,
        "command": "track", "folder": "run", "products": {},
    }  # fmt: skip
    for item in format_result("track", result, injected is not None, document):
        console.print(item)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def track() -> TrackResult:
    result = TrackResult()
    for second in (1.0, 2.0):
        values = {name: INJECTED[name] + 0.2 for name in PARAMETERS}
        result.add(
            seconds=second, residual_nm=50.0, **values, **{f"{name}_sigma": 0.1 for name in PARAMETERS}
        )
    return result


@pytest.mark.parametrize("injected", [INJECTED, None])
def test_the_registration_is_shown_with_the_injected_one(injected: dict[str, float] | None) -> None:
    text = shown(track(), injected)
    (row,) = [line.split() for line in text.splitlines() if "Shift X" in line]
    assert row[row.index("±") - 1 : row.index("±") + 2] == ["−15.80", "±", "0.10"]
    assert ("injected" in text) == (injected is not None)
    if injected is not None:
        assert row[-2:] == ["+2.0", "−16"]


def test_true_values_that_are_unknown_are_left_out_with_a_note() -> None:
    config = load_system("razor-shwfs", overrides=("twin.drift.rate.shift_x=2.0",))
    assert injected_registration(config) is not None
    behind = load_system("razor-shwfs", overrides=("twin.drift.rate.shift_x=2.0",), mode="hardware")
    assert injected_registration(behind) is None
    text = shown(track(), None, INJECTED_UNKNOWN)
    assert "injected" not in text
    assert "a clock of its own" in text


def test_without_a_drift_the_truth_needs_no_clock() -> None:
    known = injected_registration(load_system("razor-shwfs", mode="hardware"))
    assert known is not None
    assert known.at(1e6).to_dict() == pytest.approx(known.at(0.0).to_dict())


def test_the_track_of_a_sheared_mirror_is_along_the_axes() -> None:
    leaning = Registration(1.0, 2.0, 0.5, 2.5, -1.2).with_shear(1.5)
    overrides = [f"twin.registration.{name}={value!r}" for name, value in leaning.to_dict().items()]
    known = injected_registration(
        load_system("razor-shwfs", overrides=(*overrides, "twin.drift.rate.shift_x=2.0"))
    )
    assert known is not None
    trajectory = known.trajectory(10.0, [0.0, 3.0])
    assert trajectory["shift_x"] == pytest.approx([21.0, 27.0])
    assert trajectory["radial_scaling"] == pytest.approx([2.5, 2.5])
    assert trajectory["tangential_scaling"] == pytest.approx([-1.2, -1.2])
    assert known.at(13.0).axis_scalings_and_shear[1] == pytest.approx(1.5)
    assert known.trajectory(10.0, [])["shift_x"] == []


def test_a_track_without_a_row_shows_no_table() -> None:
    assert "Shift X" not in shown(TrackResult(), {})
