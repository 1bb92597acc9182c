"""The journal of a server that did not end cleanly, as the next server reads it."""

from __future__ import annotations

import json
import logging
from typing import TYPE_CHECKING, Any

import pytest

from escape_hw.remote.state import ProductEntry
from escape_hw.server.safety.journal import ServerJournal, server_folder

if TYPE_CHECKING:
    from pathlib import Path

PRODUCT = ProductEntry(name="run:3", kind="matrix", path="/data/im.fits")


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    server_folder().mkdir(parents=True)
    return server_folder()


def leave_journal(folder: Path, **content: Any) -> None:
    """The journal of a process that is gone."""
    text = json.dumps({"pid": 0, "started": 0.0, "run": None, "last_run_id": 7, "products": []} | content)
    (folder / "bench.journal.json").write_text(text)


def test_products_of_a_server_that_died_are_offered_again(folder: Path) -> None:
    leave_journal(folder, products=[PRODUCT.model_dump(mode="json")])
    journal = ServerJournal("bench")
    assert any("did not end cleanly" in note for note in journal.read_previous_end())
    assert (journal.products, journal.last_run_id) == ((PRODUCT,), 7)


@pytest.mark.parametrize("damaged", [5, [{"name": "run:3"}]], ids=["no list", "no path"])
def test_a_damaged_list_of_products_is_told(
    folder: Path, caplog: pytest.LogCaptureFixture, damaged: object
) -> None:
    leave_journal(folder, products=damaged)
    journal = ServerJournal("bench")
    with caplog.at_level(logging.WARNING):
        notes = journal.read_previous_end()
    assert "products are not offered again" in caplog.text
    assert journal.products == ()
    assert any("did not end cleanly" in note for note in notes)


@pytest.mark.parametrize("damaged", [{"pid": None}, {"pid": "x"}, {"last_run_id": []}, {"run": 3}], ids=str)
def test_a_damaged_journal_does_not_stop_the_start_of_the_server(
    folder: Path, caplog: pytest.LogCaptureFixture, damaged: dict[str, Any]
) -> None:
    leave_journal(folder, **damaged)
    with caplog.at_level(logging.WARNING):
        assert ServerJournal("bench").read_previous_end() == ()
    assert f"{folder / 'bench.journal.json'} is damaged: {next(iter(damaged))}" in caplog.text


def test_a_damaged_incident_report_is_told(folder: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = folder / "bench-12.incident.json"
    path.write_text("{")
    with caplog.at_level(logging.WARNING):
        assert ServerJournal("bench").read_incident(12) is None
        assert ServerJournal("bench").read_previous_end() == ()
    assert caplog.text.count(f"{path} is damaged") == 2
    caplog.clear()
    assert ServerJournal("bench").read_incident(13) is None
    assert not caplog.text, "most engines leave none"
