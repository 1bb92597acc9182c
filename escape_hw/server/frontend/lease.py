"""Registered clients, and the lease: the right of one client to control the server."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from escape_hw.errors import ClientUnknown, LeaseHeld, RequestRefused, ServerFull
from escape_hw.io.provenance import format_utc
from escape_hw.remote.requests import RegisterClient
from escape_hw.remote.state import Lease

log = logging.getLogger(__name__)

#: Silence after which a client is no longer registered: several of its heartbeats, which are due every 2 s.
CLIENT_TIMEOUT_S = 10.0
#: Largest number of registered clients.
MAX_CLIENTS = 200


@dataclass(slots=True)
class RegisteredClient:
    """A client, by its first request."""

    registration: RegisterClient
    #: Identity of its connection, unknown to other clients.
    route: bytes
    #: Time of its last message, monotonic seconds.
    last_message_s: float

    @property
    def description(self) -> str:
        """Name, computer and process, for people."""
        r = self.registration
        return f"{r.name} on {r.host} (process {r.pid})"

    def lease(self, since_utc: str) -> Lease:
        """The lease of this client, for the state document."""
        r = self.registration
        return Lease(client=r.client, name=r.name, host=r.host, pid=r.pid, since_utc=since_utc)


class LeaseManager:
    """Registers clients and grants the lease, which the holder loses after ``expiry_s`` of silence."""

    def __init__(self, expiry_s: float, clock: Callable[[], float] = time.monotonic) -> None:
        self.expiry_s, self._clock = expiry_s, clock
        self._clients: dict[str, RegisteredClient] = {}
        self._holder: RegisteredClient | None = None
        self._since = ""
        #: When the lease was last lost or released; ``None`` while it is held, or when it never was.
        self.released_s: float | None = None

    @property
    def lease(self) -> Lease | None:
        """The lease, for the state document."""
        if self._holder is None:
            return None
        silent_s = self._clock() - self._holder.last_message_s
        expires_in_s = max(0.0, self.expiry_s - silent_s)
        return self._holder.lease(self._since).model_copy(
            update={"silent_s": silent_s, "expires_in_s": expires_in_s}
        )

    @property
    def count(self) -> int:
        """Number of clients that sent a message lately."""
        return sum(self._clock() - one.last_message_s < self.expiry_s for one in self._clients.values())

    def register_client(self, registration: RegisterClient, route: bytes) -> None:
        """Register a client, also again after its connection was interrupted.

        ServerFull when there are too many, RequestRefused when another connection uses this client number.
        """
        self.expire()
        known = self._clients.get(registration.client)
        if known is not None and known.route != route:
            raise RequestRefused("this client number belongs to another connection; choose another one")
        if known is None and len(self._clients) >= MAX_CLIENTS:
            raise ServerFull(
                f"{MAX_CLIENTS} clients are registered already, which is the limit; open_loop, flatten and "
                "abort_procedure work without registration"
            )
        if known is None:
            client = self._clients[registration.client] = RegisteredClient(registration, route, self._clock())
            log.info("client %d: %s", len(self._clients), client.description)
        else:
            known.last_message_s = self._clock()

    def remove(self, client: RegisteredClient) -> None:
        """Remove a client that leaves, with its lease."""
        self.release(client)
        self._clients.pop(client.registration.client, None)

    def remove_connection(self, route: bytes) -> None:
        """Remove all clients of a connection that was closed."""
        for client in [one for one in self._clients.values() if one.route == route]:
            self.remove(client)

    def describe_sender(self, client: str, route: bytes) -> str:
        """Sender of a safety request, which need not be registered."""
        try:
            return self.record_activity(client, route).description
        except ClientUnknown:
            return "a client that is not registered"

    def record_activity(self, client: str, route: bytes) -> RegisteredClient:
        """Note a message of a client and return the client (ClientUnknown: not registered)."""
        known = self._clients.get(client)
        if known is None or known.route != route:
            raise ClientUnknown("this connection is not registered under that client number; reconnect")
        known.last_message_s = self._clock()
        return known

    def acquire(self, client: RegisteredClient, take_over: bool) -> Lease:
        """Grant the lease to a client (LeaseHeld: another client holds it)."""
        holder = self._holder
        if holder is not None and holder is not client:
            if not take_over:
                raise LeaseHeld(
                    f"{holder.description} has had control since {self._since} UTC; ask there, or take over"
                )
            log.warning("%s takes control over from %s", client.description, holder.description)
        elif holder is None:
            log.info("%s has control", client.description)
        if holder is not client:
            self._holder, self._since = client, format_utc()
        self.released_s = None
        return client.lease(self._since)

    def release(self, client: RegisteredClient) -> None:
        """Release the lease of a client; does nothing when it has none."""
        if self._holder is client:
            log.info("%s releases control", client.description)
            self._holder, self.released_s = None, self._clock()

    def require(self, client: RegisteredClient) -> None:
        """Check that a client holds the lease (LeaseHeld: it does not)."""
        if self._holder is client:
            return
        if self._holder is None:
            raise LeaseHeld("no client has control; acquire it first (connect with control=True)")
        raise LeaseHeld(f"{self._holder.description} has had control since {self._since} UTC")

    def expire(self) -> None:
        """Take the lease from a silent holder, and remove clients that are gone."""
        now = self._clock()
        holder = self._holder
        if holder is not None and now - holder.last_message_s > self.expiry_s:
            log.warning(
                "%s was silent for %.1f s (limit %g s) and loses control",
                holder.description, now - holder.last_message_s, self.expiry_s,
            )  # fmt: skip
            self._holder, self.released_s = None, now
        timeout_s = max(CLIENT_TIMEOUT_S, self.expiry_s)
        for number in [key for key, one in self._clients.items() if now - one.last_message_s > timeout_s]:
            del self._clients[number]

    def seconds_without_holder(self) -> float:
        """Seconds since the lease was last held; 0 while it is held, or when it never was."""
        return 0.0 if self.released_s is None else self._clock() - self.released_s
