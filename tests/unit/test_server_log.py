"""The log of a server: numbers and publication of its lines."""

from __future__ import annotations

import logging
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from escape_hw.errors import StorageError
from escape_hw.remote.state import LogLine
from escape_hw.server.ipc.log import ServerLog

log = logging.getLogger("escape_hw.server.test")


@pytest.fixture
def published() -> list[LogLine]:
    return []


@pytest.fixture
def server_log(published: list[LogLine], tmp_path: Path) -> Iterator[ServerLog]:
    made = ServerLog(tmp_path / "small.log", published.append, first_number=10**9)
    yield made
    made.close()


def test_lines_are_numbered_without_gaps_and_written(
    server_log: ServerLog, published: list[LogLine], tmp_path: Path
) -> None:
    assert server_log.last_number == -1
    log.info("a")
    server_log.add(LogLine(number=0, at_utc="2026-11-22T20:00:00", level="ERROR", logger="engine", text="b"))
    log.info("c")
    assert [(line.number - 10**9, line.text) for line in published] == [(0, "a"), (1, "b"), (2, "c")]
    assert server_log.last_number == 10**9 + 2
    assert server_log.after(10**9, 100) == published[1:]
    assert [line.split(": ")[-1] for line in (tmp_path / "small.log").read_text().splitlines()] == [*"abc"]


def test_lines_of_other_threads_are_published_by_the_first(
    server_log: ServerLog, published: list[LogLine]
) -> None:
    """The socket that publishes belongs to one thread."""
    threads = [threading.Thread(target=lambda: [log.info("x") for _ in range(50)]) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert published == []
    server_log.flush()
    assert [line.number - 10**9 for line in published] == list(range(200))


@pytest.mark.parametrize("blocked", ["server", "server/small.log"], ids=["folder", "file"])
def test_a_log_that_cannot_be_written_is_refused(tmp_path: Path, blocked: str) -> None:
    if blocked == "server":
        (tmp_path / blocked).touch()
    else:
        (tmp_path / blocked).mkdir(parents=True)
    with pytest.raises(StorageError, match=r"small\.log: the log of the server .* set XDG_DATA_HOME"):
        ServerLog(tmp_path / "server" / "small.log", [].append)
