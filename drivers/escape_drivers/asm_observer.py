"""Watches an adaptive secondary that somebody else controls."""

from __future__ import annotations

import time
from collections.abc import Callable
from types import TracebackType
from typing import Self

from escape_drivers import asm_messages as m
from escape_drivers.asm_codec import AsmCodec
from escape_drivers.asm_link import AsmLink
from escape_drivers.asm_options import PORT
from escape_hw.errors import FrameTimeout


class AsmObserver:
    """A connection over which the mirror tells its telemetry, health and faults; usable with ``with``.

    Any number may watch. Who does not keep up gets the newest sample, not the oldest.

    Parameters
    ----------
    name
        For messages.
    host, port
        Where the mirror's gateway listens.
    patience_s
        Longest wait for a connection, seconds.
    make_codec
        Makes the codec of a connection.

    Attributes
    ----------
    health, fault
        The last of either that was told, or ``None``.
    """

    def __init__(
        self,
        name: str,
        host: str,
        port: int = PORT,
        *,
        patience_s: float = 2.0,
        make_codec: Callable[[], m.Codec] = AsmCodec,
    ) -> None:
        self.name = name
        self.health: m.Health | None = None
        self.fault: m.Fault | None = None
        self._newest: m.Telemetry | None = None
        self._link = AsmLink(
            name, (host, port), m.Role.TELEMETRY, make_codec,
            connect_s=patience_s, reply_s=patience_s, unasked=self._listen,
        )  # fmt: skip

    def __enter__(self) -> Self:
        """Connect.

        Raises
        ------
        DeviceError
            Nobody answers, or the mirror refuses.
        """
        self._link.connect()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Disconnect."""
        self._link.drop("it was closed")

    def sample(self, timeout_s: float = 1.0) -> m.Telemetry:
        """Wait for the next sample: command, positions, currents and flags of every actuator.

        Raises
        ------
        FrameTimeout
            None came in time.
        DeviceLost
            The connection broke.
        """
        deadline = time.monotonic() + timeout_s
        while self._newest is None:
            left = deadline - time.monotonic()
            if left <= 0:
                raise FrameTimeout(self.name, f"no telemetry within {timeout_s:g} s; see 'escape asm status'")
            for reply in self._link.receive(left):
                self._listen(reply)
        newest, self._newest = self._newest, None
        return newest

    def _listen(self, news: m.Reply) -> None:
        if isinstance(news, m.Telemetry):
            self._newest = news
        elif isinstance(news, m.Health):
            self.health = news
        elif isinstance(news, m.Fault):
            self.fault = news
