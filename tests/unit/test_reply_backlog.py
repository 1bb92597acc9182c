"""Replies that wait for slow readers are bounded."""

from __future__ import annotations

from collections.abc import Sequence

from escape_hw.server.frontend.backlog import (
    MAX_BYTES,
    MAX_REPLIES,
    MAX_SECONDS,
    MAX_TOTAL_BYTES,
    ReplyBacklogs,
)


class Clock:
    now = 100.0

    def __call__(self) -> float:
        return self.now


def test_replies_are_sent_in_order_as_far_as_they_are_accepted() -> None:
    backlogs, sent = ReplyBacklogs(), []
    for number in range(5):
        backlogs.add(b"a", [b"%d" % number])

    def accept_three(sender: bytes, parts: Sequence[bytes]) -> bool:
        if len(sent) == 3:
            return False
        sent.append(parts[0])
        return True

    backlogs.flush(accept_three)
    assert sent == [b"0", b"1", b"2"]
    assert b"a" in backlogs
    backlogs.flush(lambda sender, parts: True)
    assert not backlogs


def test_every_bound_removes_the_slow_reader_only() -> None:
    clock = Clock()
    backlogs = ReplyBacklogs(clock)
    backlogs.add(b"one", [b"x" * (MAX_BYTES + 1)])  # a single large reply is allowed
    backlogs.add(b"bytes", [b"x" * MAX_BYTES])
    backlogs.add(b"bytes", [b"x"])
    for _ in range(MAX_REPLIES + 1):
        backlogs.add(b"many", [b""])
    assert [sender for sender, _ in backlogs.remove_slow()] == [b"bytes", b"many"]
    clock.now += MAX_SECONDS / 2
    backlogs.add(b"late", [b""])
    clock.now += MAX_SECONDS / 2 + 1
    assert [sender for sender, _ in backlogs.remove_slow()] == [b"one"]
    assert b"late" in backlogs


def test_all_connections_together_are_bounded() -> None:
    backlogs = ReplyBacklogs()
    for number in range(2 * MAX_TOTAL_BYTES // MAX_BYTES):
        backlogs.add(b"%d" % number, [b"x" * MAX_BYTES])
    assert list(backlogs.remove_slow())
    assert backlogs.total_bytes <= MAX_TOTAL_BYTES
