"""Reports of nights: Markdown and HTML with figures, from Python and from the command line."""

from __future__ import annotations

import json
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from typer.testing import CliRunner

from escape_hw.cli.app import app
from escape_hw.errors import ConfigError, ProductError
from escape_hw.io.night_log import NightEntry, night_of, night_path
from escape_hw.io.provenance import format_utc
from escape_hw.report.night_log import NightReport

EVENING = datetime(2026, 11, 20, 21, 0, tzinfo=UTC)


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two nights of a bench."""
    runs = tmp_path_factory.mktemp("runs")
    for day in range(2):
        evening = EVENING + timedelta(days=day)
        entries = [
            NightEntry(
                number=0, at_utc=format_utc(evening), kind="note", text="<b>first\nlight", author="ana"
            )
        ]
        entries += [
            NightEntry(
                number=k + 1,
                at_utc=format_utc(evening + timedelta(seconds=10 * k)),
                kind="sample",
                values={
                    "strehl": 40.0 + k,
                    "strength": 20.0,
                    "r0_m": 0.1,
                    "seeing": 1.01,
                    "shift_x": -16.0 + k,
                },
                simulated=True,
            )
            for k in range(5)
        ]
        entries.append(NightEntry(number=6, at_utc=format_utc(evening), kind="fault", text="FAULT: no frame"))
        path = night_path(runs, "bench", night_of(evening))
        path.parent.mkdir()
        path.write_text("".join(entry.model_dump_json(exclude_defaults=True) + "\n" for entry in entries))
    return runs


def test_markdown_has_the_log_the_medians_and_figures_beside_it(runs: Path, tmp_path: Path):
    report = NightReport.read(runs)
    assert report.night == night_of(EVENING + timedelta(days=1))
    assert len(report.nights) == 2
    text, *figures = report.write(tmp_path / "my night.md")
    content = text.read_text()
    assert "**SIMULATED**" in content
    assert "| Strehl ratio | 42.0 (40.6 to 43.4) % |" in content
    assert "| Shift x | -14.0 (-15.4 to -12.6) % of a sub-aperture |" in content
    # All values are equal.
    assert "| Seeing at 500 nm | 1.01 arcsec |" in content
    assert "note, ana: <b>first light" in content
    assert "FAULT: no frame" in content
    assert [path.name for path in figures] == ["my night_night.png", "my night_nights.png"]
    assert "(my%20night_night.png)" in content
    assert all(path.read_bytes().startswith(b"\x89PNG") for path in figures)


def test_html_is_self_contained_and_escapes_notes(runs: Path, tmp_path: Path):
    (page,) = NightReport.read(runs, "bench", night_of(EVENING)).write(tmp_path / "night.html")
    content = page.read_text()
    assert content.count("<svg") == 1
    assert "&lt;b&gt;first" in content
    assert "<b>first" not in content
    assert "SIMULATED" in content


def test_errors_name_the_nights_and_the_formats(runs: Path, tmp_path: Path):
    with pytest.raises(ProductError, match=r"no night log of bench 2020-01-01; there are: 2026-11-2"):
        NightReport.read(runs, "bench", "2020-01-01")
    with pytest.raises(ProductError, match="there are: none"):
        NightReport.read(tmp_path)
    with pytest.raises(ConfigError, match=r"\.md or \.html"):
        NightReport.read(runs).write(tmp_path / "night.pdf")


def test_the_command_prints_and_writes_the_log(runs: Path, tmp_path: Path):
    shown = CliRunner().invoke(app, ["night-log", "bench", "--runs", str(runs)])
    assert shown.exit_code == 0, shown.output
    assert "first" in shown.output
    assert "FAULT: no frame" in shown.output
    out = tmp_path / "out" / "night.html"
    written = CliRunner().invoke(app, ["night-log", "--runs", str(runs), "--out", str(out), "--json"])
    document = json.loads(written.stdout)
    assert document["files"] == [str(out)]
    assert len(document["entries"]) == 7
    assert out.is_file()
    missing = CliRunner().invoke(app, ["night-log", "--runs", str(tmp_path / "none")])
    assert missing.exit_code == 2
