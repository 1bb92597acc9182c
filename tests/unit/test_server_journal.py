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
