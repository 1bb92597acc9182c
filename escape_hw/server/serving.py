"""Opening the door of a server, and closing it behind."""

from __future__ import annotations

import logging
import os
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Self

import zmq
from zmq.auth.thread import ThreadAuthenticator

from escape_hw.api.procedure import Stop
from escape_hw.config.models import SystemConfig
from escape_hw.errors import ConfigError
from escape_hw.remote.address import (
    Endpoint,
    Listing,
    find_listing,
    is_loopback,
    list_server,
    local_endpoint,
    tcp_endpoint,
    unlist_server,
)
from escape_hw.remote.keys import allowed_keys, server_keys
from escape_hw.server.door import Door
from escape_hw.server.front import Front
from escape_hw.streams.segments import process_start

log = logging.getLogger(__name__)


class Allowed:
    """Says whether a key is allowed; asked at every connection, so that changes count at once."""

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether the client with this public key is let in."""
        names = [name for name, known in allowed_keys().items() if known == key]
        log.log(
            logging.INFO if names else logging.WARNING, "key %s: %s", key.decode(), names or "not allowed"
        )
        return bool(names)


class Serving:
    """A server that listens, from its sockets to its entry in the user's list; a context manager.

    Parameters
    ----------
    config
        The system.
    host, port
        Address to listen on beside the local sockets; no port: none.

    Raises
    ------
    ConfigError
        The system is served already, or the address cannot be had.
    """

    def __init__(self, config: SystemConfig, host: str = "127.0.0.1", port: int | None = None) -> None:
        self._config, self._stack = config, ExitStack()
        name, pid = config.system.name, os.getpid()
        running = find_listing(name)
        if running is not None and running.alive:
            raise ConfigError(f"'{name}' is served by process {running.pid} already; stop that one first")
        if running is not None:
            unlist_server(running)
        local = local_endpoint(name, pid)
        tcp = "" if port is None else tcp_endpoint(host, port).requests
        self.listing = Listing(name, pid, process_start(pid) or 0, local.requests, local.events, tcp)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._stack.callback(context.term)
        self._door = Door(context)
        try:
            self._stack.callback(unlist_server, self.listing)
            self._stack.callback(self._door.close)
            self._open(context, local, None if port is None else tcp_endpoint(host, port), host)
        except BaseException:
            self._stack.close()
            raise

    def _open(
        self, context: zmq.Context[zmq.Socket[bytes]], local: Endpoint, tcp: Endpoint | None, host: str
    ) -> None:
        if tcp is None or is_loopback(host):
            self._door.open(*(one for one in (local, tcp) if one is not None))
            return
        keys = server_keys()
        guard = ThreadAuthenticator(context)
        guard.start()
        self._stack.callback(guard.stop)
        guard.configure_curve_callback("escape", Allowed())
        self._door.open(local)
        self._door.open(tcp, keys=keys)

    def run(self, stop: Stop, runs: Path, reads: tuple[Path, ...] = ()) -> None:
        """Serve until told to stop."""
        list_server(self.listing)
        Front(self._config, self._door, runs, reads).run(stop)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()
