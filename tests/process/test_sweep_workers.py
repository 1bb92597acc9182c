"""Worker processes that end are replaced; after repeated failures the sweep gives up."""

from __future__ import annotations

import os
import threading
import time
from pathlib import Path

import pytest
from serving import wait_for

from escape_hw.errors import CalibrationError
from escape_hw.runtime.sweep.workers import LocalWorkers


@pytest.fixture
def workers():
    one = LocalWorkers(1)
    yield one
    one.close()


def die_once(mark: str) -> str:
    """End the process the first time; afterwards return."""
    path = Path(mark)
    if path.exists():
        return "done"
    path.touch()
    os._exit(1)


def begin_and_sleep(mark: str) -> None:
    Path(mark).touch()
    time.sleep(60)


def test_a_call_whose_worker_ends_is_made_again(workers, tmp_path):
    assert workers.run(die_once, str(tmp_path / "mark")) == "done"


def test_errors_of_a_call_are_raised(workers):
    with pytest.raises(ValueError, match="invalid literal"):
        workers.run(int, "x")


def test_workers_that_die_again_and_again_are_given_up(workers):
    with pytest.raises(CalibrationError, match="die again and again"):
        workers.run(os._exit, 1)


def test_closing_ends_a_call_at_once(workers, tmp_path):
    found = []

    def wait() -> None:
        try:
            workers.run(begin_and_sleep, str(tmp_path / "begun"))
        except CalibrationError as error:
            found.append(str(error))

    thread = threading.Thread(target=wait)
    thread.start()
    wait_for((tmp_path / "begun").exists, "the call begins")
    began = time.monotonic()
    workers.close()
    thread.join(10)
    assert time.monotonic() - began < 5
    assert found == ["the workers are closed"]
