"""Observes an adaptive secondary that another client controls."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Self

from escape_drivers.asm import messages as m
from escape_drivers.asm.codec import AsmCodec
from escape_drivers.asm.link import AsmLink
from escape_drivers.asm.options import DEFAULT_PORT
from escape_hw.errors import FrameTimeout


class AsmObserver:
    """A connection that receives the mirror's telemetry, health and faults; a context manager.

    Any number of observers may connect. A slow observer gets the newest sample. Numbering and sign are those
    of the hardware. ``connect_timeout_s`` is the longest wait for a connection and for an answer.

    Attributes
    ----------
    health, fault
        The last report of either kind, or ``None``.
    """

    def __init__(
        self,
        name: str,
        host: str,
        port: int = DEFAULT_PORT,
        *,
        connect_timeout_s: float = 2.0,
        make_codec: Callable[[], m.Codec] = AsmCodec,
    ) -> None:
        self.name = name
        self.health: m.HealthReport | None = None
        self.fault: m.FaultReport | None = None
        self._newest: m.TelemetrySample | None = None
        self._link = AsmLink(
            name, (host, port), m.Role.TELEMETRY, make_codec,
            connect_s=connect_timeout_s, reply_s=connect_timeout_s, on_unsolicited=self._on_unsolicited,
        )  # fmt: skip

    def __enter__(self) -> Self:
        """Connect; raises ``DeviceError`` if the host does not answer or the mirror refuses."""
        self._link.connect()
        return self

    def __exit__(self, *exception: object) -> None:
        self._link.disconnect("it was closed")

    def sample(self, timeout_s: float = 1.0) -> m.TelemetrySample:
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
                self._on_unsolicited(reply)
        newest, self._newest = self._newest, None
        return newest

    def _on_unsolicited(self, message: m.Reply) -> None:
        if isinstance(message, m.TelemetrySample):
            self._newest = message
        elif isinstance(message, m.HealthReport):
            self.health = message
        elif isinstance(message, m.FaultReport):
            self.fault = message
