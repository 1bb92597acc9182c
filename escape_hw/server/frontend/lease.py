"""Who may write: one client at a time, for as long as it is heard of."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from escape_hw.errors import ClientUnknown, LeaseHeld, RequestRefused
from escape_hw.io.provenance import format_utc
from escape_hw.remote.requests import RegisterClient
from escape_hw.remote.state import Lease

log = logging.getLogger(__name__)

#: Clients that were not heard of for so long are forgotten.
_CLIENT_TIMEOUT_S = 60.0
#: More clients than this are not a control room.
MAX_CLIENTS = 200


@dataclass(slots=True)
class RegisteredClient:
    """Somebody who said hello.

    Parameters
    ----------
    route
        The connection, as the socket tells them apart; other clients never learn it.
    """

    hello: RegisterClient
    route: bytes
    last_message_s: float

    @property
    def description(self) -> str:
        """Who it is, for people."""
        return f"{self.hello.name} on {self.hello.host} (process {self.hello.pid})"


class LeaseManager:
    """The clients that are there, and which of them may write.

    Parameters
    ----------
    expiry_s
        A holder that was not heard of for so long loses the lease.
    clock
        Monotonic seconds.
    """

    def __init__(self, expiry_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.expiry_s, self._clock = expiry_s, clock
        self._clients: dict[str, RegisteredClient] = {}
        self._holder: RegisteredClient | None = None
        self._since = ""
        #: When the lease was last lost or given back; ``None``: it is held, or never was.
        self.released_s: float | None = None

    @property
    def lease(self) -> Lease | None:
        """The lease as the state tells it."""
        if self._holder is None:
            return None
        hello = self._holder.hello
        return Lease(
            client=hello.client, name=hello.name, host=hello.host, pid=hello.pid, since_utc=self._since
        )

    @property
    def count(self) -> int:
        """Clients heard of lately."""
        return sum(self._clock() - one.last_message_s < self.expiry_s for one in self._clients.values())

    def register_client(self, hello: RegisterClient, route: bytes) -> None:
        """Take a client in, or take it back after its connection was interrupted.

        Raises
        ------
        RequestRefused
            Too many clients, or somebody else goes by that number.
        """
        known = self._clients.get(hello.client)
        if known is not None and known.route != route:
            raise RequestRefused("this client number belongs to another connection; draw another one")
        if known is None and len(self._clients) >= MAX_CLIENTS:
            raise RequestRefused(f"{MAX_CLIENTS} clients are here already")
        if known is None:
            self._clients[hello.client] = RegisteredClient(hello, route, self._clock())
            log.info("client %d: %s", len(self._clients), self._clients[hello.client].description)
        else:
            known.last_message_s = self._clock()

    def record_activity(self, client: str, route: bytes) -> RegisteredClient:
        """Note that a client lives.

        Raises
        ------
        ClientUnknown
            It has not said hello, was forgotten since, or speaks for somebody else.
        """
        known = self._clients.get(client)
        if known is None or known.route != route:
            raise ClientUnknown("say hello first: this connection is not known under that client number")
        known.last_message_s = self._clock()
        return known

    def acquire(self, client: RegisteredClient, take_over: bool) -> Lease:
        """Give a client the lease.

        Raises
        ------
        LeaseHeld
            Somebody else has it; says who and since when.
        """
        holder = self._holder
        if holder is not None and holder is not client:
            if not take_over:
                raise LeaseHeld(
                    f"{holder.description} has had the right to write since {self._since} UTC; ask there, or take "
                    "it over"
                )
            log.warning("%s takes the right to write over from %s", client.description, holder.description)
        elif holder is None:
            log.info("%s has the right to write", client.description)
        if holder is not client:
            self._holder, self._since = client, format_utc()
        self.released_s = None
        lease = self.lease
        if lease is None:
            raise RuntimeError("a lease that was just given is gone")
        return lease

    def release(self, client: RegisteredClient) -> None:
        """Take the lease back from a client; does nothing when it has none."""
        if self._holder is client:
            log.info("%s gives the right to write back", client.description)
            self._holder, self.released_s = None, self._clock()

    def require(self, client: RegisteredClient) -> None:
        """Let pass who has the lease.

        Raises
        ------
        LeaseHeld
            Somebody else has it, or nobody.
        """
        if self._holder is client:
            return
        if self._holder is None:
            raise LeaseHeld("nobody has the right to write; acquire it first (connect with control=True)")
        raise LeaseHeld(f"{self._holder.description} has had the right to write since {self._since} UTC")

    def expire(self) -> None:
        """Take the lease from a holder that was not heard of; forget clients that are gone."""
        now = self._clock()
        holder = self._holder
        if holder is not None and now - holder.last_message_s > self.expiry_s:
            log.warning(
                "%s was not heard of for %.1f s (limit %g s) and loses the right to write",
                holder.description, now - holder.last_message_s, self.expiry_s,
            )  # fmt: skip
            self._holder, self.released_s = None, now
        for number in [
            key for key, one in self._clients.items() if now - one.last_message_s > _CLIENT_TIMEOUT_S
        ]:
            del self._clients[number]

    def seconds_without_holder(self) -> float:
        """Seconds since the lease was last held; 0 while it is, or when it never was."""
        return 0.0 if self.released_s is None else self._clock() - self.released_s
