"""Replies that wait for slow readers: bounded in bytes, number and time for every connection."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

#: Bounds of one connection: bytes, replies, and seconds without a reply that it accepts.
MAX_BYTES, MAX_REPLIES, MAX_SECONDS = 8 << 20, 200, 10.0
#: Bytes of all connections.
MAX_TOTAL_BYTES = 128 << 20


@dataclass(slots=True)
class _Backlog:
    """Replies of one connection, their bytes, and when the last one was accepted (monotonic seconds)."""

    accepted_s: float
    replies: deque[Sequence[bytes]] = field(default_factory=deque)
    size: int = 0


class ReplyBacklogs:
    """The replies that wait, by connection; a connection without a waiting reply has no entry."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._backlogs: dict[bytes, _Backlog] = {}

    def __contains__(self, sender: bytes) -> bool:
        return sender in self._backlogs

    def __bool__(self) -> bool:
        return bool(self._backlogs)

    @property
    def total_bytes(self) -> int:
        """Bytes of all waiting replies."""
        return sum(one.size for one in self._backlogs.values())

    def add(self, sender: bytes, parts: Sequence[bytes]) -> None:
        """Add a reply behind those of this connection that wait already."""
        backlog = self._backlogs.setdefault(sender, _Backlog(self._clock()))
        backlog.replies.append(parts)
        backlog.size += sum(map(len, parts))

    def flush(self, try_send: Callable[[bytes, Sequence[bytes]], bool]) -> None:
        """Pass on what ``try_send`` accepts, in the order of the replies of a connection."""
        for sender, backlog in tuple(self._backlogs.items()):
            while backlog.replies and try_send(sender, backlog.replies[0]):
                backlog.size -= sum(map(len, backlog.replies.popleft()))
                backlog.accepted_s = self._clock()
            if not backlog.replies:
                del self._backlogs[sender]

    def remove_slow(self) -> Iterator[tuple[bytes, str]]:
        """Remove the connections beyond a bound; yields them with the reason."""
        now = self._clock()
        for sender, backlog in tuple(self._backlogs.items()):
            waited_s = now - backlog.accepted_s
            if (
                (backlog.size > MAX_BYTES and len(backlog.replies) > 1)
                or len(backlog.replies) > MAX_REPLIES
                or waited_s > MAX_SECONDS
            ):  # fmt: skip
                del self._backlogs[sender]
                yield (
                    sender,
                    f"{len(backlog.replies)} replies of {backlog.size / 1e6:.1f} MB were not read "
                    f"for {waited_s:.1f} s",
                )
        while self.total_bytes > MAX_TOTAL_BYTES:
            sender = max(self._backlogs, key=lambda one: self._backlogs[one].size)
            size = self._backlogs.pop(sender).size
            yield sender, f"{size / 1e6:.1f} MB were not read while other clients do not read either"
