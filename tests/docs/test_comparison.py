"""The comparison's short table agrees with the performance page; its packages have versions and dates."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

DOCS = Path(__file__).parents[2] / "docs"
PAGE = (DOCS / "comparison.md").read_text(encoding="utf-8")
#: Rows of the comparison, and the measurement that each is of.
STAGES = {
    "frames per second of the simulated bench": "optics: twin frames",
    "time per frame of DO-CRIME's sums, 97 modes": "docrime: time per frame, recorded",
    "matrix error, same telemetry, turbulence of f^(−11/3)": "docrime: IM error, turbulence of f^-11/3",
    "matrix error, read noise only": "docrime: IM error, read noise only",
    "leaky integrator 1200 × 2512": "pipeline: integrator 1200 x 2512",
    "a command to the adaptive secondary and its acknowledgement": "asm: command and acknowledgement",
}


def rows(text: str) -> dict[str, list[str]]:
    cells = [
        [cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines() if "|" in line
    ]
    return {name: rest for name, *rest in cells}


@pytest.mark.parametrize("row", STAGES)
def test_the_short_table_is_that_of_the_performance_page(row: str) -> None:
    measured = rows((DOCS / "performance.md").read_text(encoding="utf-8"))[STAGES[row]]
    quoted = rows(PAGE.partition("## Measured in one run")[2])[row]
    for said, found in zip(quoted[:2], measured[:2], strict=True):
        value = float(re.match(r"[\d.]+", said)[0])  # type: ignore[index]
        assert value == pytest.approx(float(found), rel=0.03), f"{row}: {said}, measured {found}"


def test_every_package_has_a_version_and_a_date() -> None:
    found = rows(PAGE.partition("| | ESCAPE")[0])
    for name in ("pyRTC (`pyrtcao`)", "OOPAO", "SPECULA", "synim"):
        version, date = found[name][:2]
        assert re.fullmatch(r"\d+\.\d+\.\d+", version)
        assert re.fullmatch(r"\d{1,2} [A-Z][a-z]+ 20\d\d", date)
    assert "not run here" in found["CACAO with milk"][2]
