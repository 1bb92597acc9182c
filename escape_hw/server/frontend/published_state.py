"""The state that clients see: the engine's state with what the front end adds."""

from __future__ import annotations

import os

from escape_hw.remote.state import State
from escape_hw.server.frontend.lease import LeaseManager
from escape_hw.server.frontend.transport import ZmqTransport


class PublishedState:
    """Holds and publishes the state; its ``notes`` stay."""

    def __init__(self, state: State, leases: LeaseManager, transport: ZmqTransport) -> None:
        self.state, self._leases, self._transport = state, leases, transport

    def update(self, state: State | None = None) -> None:
        """Publish a new state of the engine, or the present one with new front-end values."""
        before = self.state
        self.state = (before if state is None else state).model_copy(
            update={
                "serial": before.serial + 1, "server_pid": os.getpid(), "lease": self._leases.lease,
                "clients": self._leases.count, "refused_requests": self._transport.refused,
                "notes": before.notes,
            }
        )  # fmt: skip
        self._transport.publish("state", self.state)
