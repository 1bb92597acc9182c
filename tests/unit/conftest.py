"""Common fixtures of the command-line tests: fake devices, and functions to call it."""

from __future__ import annotations

import fake_bench
import fake_results as fake
import pytest
from command_line import document, escape
from quick_benches import little_noise

from escape_hw.io.fits.matrix import save_matrix
from escape_hw.report.figures import style
from escape_hw.report.run_report import REPORT, write_report

__all__ = [
    "bench", "document", "empty_reports", "escape", "im", "little_noise", "pictures", "reports", "undrawn",
]  # fmt: skip

PNG = style.png


def empty_report(folder):
    """A page without content, in its place."""
    path = folder / REPORT
    path.write_text("")
    return path


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """Fake devices and procedures, and no time spent on figures."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("escape_hw.runtime.procedures.products.write_report", lambda folder: folder)
    monkeypatch.setattr(style, "png", lambda figure, dpi=150: b"")
    return fake_bench.install(monkeypatch)


@pytest.fixture
def undrawn(monkeypatch):
    """Reports whose figures are made and not drawn, which takes most of the time; test_report draws them."""
    monkeypatch.setattr(style, "svg", lambda figure, key: "<svg></svg>")


@pytest.fixture
def reports(bench, undrawn, monkeypatch):
    """The real report after all, without drawings."""
    monkeypatch.setattr("escape_hw.runtime.procedures.products.write_report", write_report)


@pytest.fixture
def pictures(bench, monkeypatch):
    """The real pictures after all."""
    monkeypatch.setattr(style, "png", PNG)


@pytest.fixture
def empty_reports(bench, monkeypatch):
    """Pages without content where the reports would be."""
    monkeypatch.setattr("escape_hw.runtime.procedures.products.write_report", empty_report)


@pytest.fixture
def im(tmp_path):
    return save_matrix(tmp_path / "im.fits", fake.calibration("escape"), fake.ORIGIN)
