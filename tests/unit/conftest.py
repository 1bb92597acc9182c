"""Common fixtures of the command-line tests: fake devices, and functions to call it."""

from __future__ import annotations

import fake_bench
import fake_results as fake
import pytest
from command_line import document, escape

from escape_hw.io.fits.matrix import save_matrix
from escape_hw.report.run_report import write_report

__all__ = ["bench", "document", "escape", "im", "reports"]


@pytest.fixture
def bench(monkeypatch, tmp_path):
    """Fake devices and procedures, and no time spent on figures."""
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path / "data"))
    monkeypatch.setattr("escape_hw.runtime.procedures.products.write_report", lambda folder: folder)
    return fake_bench.install(monkeypatch)


@pytest.fixture
def reports(bench, monkeypatch):
    """The real report after all."""
    monkeypatch.setattr("escape_hw.runtime.procedures.products.write_report", write_report)


@pytest.fixture
def im(tmp_path):
    return save_matrix(tmp_path / "im.fits", fake.calibration("escape"), fake.ORIGIN)
