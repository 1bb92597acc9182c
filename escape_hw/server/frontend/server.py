"""The front end: poll loop, dispatch of client requests, and the life of a listening server."""

from __future__ import annotations

import logging
import os
import time
from collections.abc import Callable
from contextlib import ExitStack
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import zmq
from zmq.auth.thread import ThreadAuthenticator

from escape_hw.api.procedure import StopSignal
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError, EscapeError, RequestRefused
from escape_hw.remote import requests
from escape_hw.remote.address import (
    Endpoint,
    ServerListing,
    find_server,
    is_loopback,
    local_endpoint,
    register_server,
    tcp_endpoint,
    unregister_server,
)
from escape_hw.remote.keys import allowed_keys, server_keys
from escape_hw.remote.source import STREAMS
from escape_hw.remote.state import SCHEMA, Phase, State
from escape_hw.server.frontend.engine_supervisor import SAFETY_REQUESTS, EngineSupervisor, PendingRequest
from escape_hw.server.frontend.lease import RegisteredClient
from escape_hw.server.frontend.transport import IncomingRequest, ZmqTransport
from escape_hw.server.ipc.channel import EngineSetup
from escape_hw.streams.ring import ReaderCache
from escape_hw.streams.segments import process_start


class StreamSampler:
    """Reads the engine's rings."""

    def __init__(self) -> None:
        self._readers = ReaderCache()

    def latest(
        self, stream: str, segment: str | None, after: int
    ) -> tuple[dict[str, Any] | None, bytes | None]:
        """Head and bytes of a stream's newest entry; nothing when there is none newer than ``after``.

        Parameters
        ----------
        stream
            Its name.
        segment
            Where it lies; ``None``: nowhere yet.
        after
            Index of the entry that the client has.
        """
        reader = self._readers.reader(stream, segment)
        sample = None if reader is None else reader.latest(after)
        if sample is None:
            return None, None
        head = {
            "index": sample.index, "exposed_ns": sample.exposed_ns, "arrived_ns": sample.arrived_ns,
            "dtype": sample.data.dtype.str, "shape": list(sample.data.shape), "meta": dict(sample.meta),
        }  # fmt: skip
        return head, sample.data.tobytes()

    def close(self) -> None:
        """Let go of the rings."""
        self._readers.close()


log = logging.getLogger(__name__)

_POLL_MS = 50


class FrontEnd(EngineSupervisor):
    """Serves one system.

    Parameters
    ----------
    config
        The system.
    door
        The sockets, bound.
    runs
        Folder under which runs go.
    reads
        Further folders that products may be loaded from.
    """

    def __init__(
        self, config: SystemConfig, transport: ZmqTransport, runs: Path, reads: tuple[Path, ...] = ()
    ) -> None:
        super().__init__(config, transport, EngineSetup(config_text=config.to_toml(), runs=runs, reads=reads))
        self._sampler, self._last_request_id = StreamSampler(), 0
        self._handlers: dict[
            type[requests.Request], Callable[[Any, IncomingRequest, RegisteredClient], object]
        ] = {
            requests.GetState: lambda request, incoming, client: self._state,
            requests.GetLog: lambda request, incoming, client: [
                line.model_dump(mode="json") for line in self._log.after(request.after, request.count)
            ],
            requests.AcquireLease: self._acquire,
            requests.ClientHeartbeat: lambda request, incoming, client: None,
            requests.ReleaseLease: self._release,
        }

    # ------------------------------------------------------------ life
    def run(self, stop: StopSignal) -> None:
        """Serve until told to stop; the mirror ends flat."""
        poller = zmq.Poller()
        for socket in self._transport.sockets:
            poller.register(socket, zmq.POLLIN)
        try:
            while not self._stopping:
                engine = self._engine if self._engine is not None and not self._engine.has_exited() else None
                if engine is not None:
                    poller.register(engine.connection.fileno(), zmq.POLLIN)
                poller.poll(_POLL_MS)
                if engine is not None:
                    poller.unregister(engine.connection.fileno())
                    self._receive_messages(engine)
                for incoming in self._transport.receive_requests():
                    self._handle_request(incoming)
                self._check_engine()
                if stop.is_set() and not self._stop_requested_s:
                    self._shut_down()
        finally:
            self._close()

    def _shut_down(self) -> None:
        self._stop_requested_s = time.monotonic()
        log.info("stopping: mirror flat, devices closed")
        if self._engine is None:
            self._stopping = True
        else:
            self._engine.send({"end": True})

    def _close(self) -> None:
        engine, self._engine = self._engine, None
        clean = True
        if engine is not None:
            engine.close_channel()
            clean = engine.close()
        self._state = self._state.model_copy(
            update={"phase": Phase.STOPPED, "serial": self._state.serial + 1}
        )
        self._transport.publish("state", self._state)
        if clean:
            self._journal.close()
        self._sampler.close()
        self._log.close()

    # ------------------------------------------------------------ clients speak
    def _handle_request(self, incoming: IncomingRequest) -> None:
        request = incoming.request
        try:
            if isinstance(request, requests.RegisterClient):
                self._transport.answer(incoming.route, self._register_client(request, incoming.route.sender))
                return
            client = self._leases.record_activity(request.client, incoming.route.sender)
            if isinstance(request, requests.LEASE_REQUESTS):
                self._leases.require(client)
            if isinstance(request, SAFETY_REQUESTS):
                log.warning("%s: %s", client.description, request.verb.replace("_", " "))
            if isinstance(request, requests.GetLatestSample):
                self._send_latest(request, incoming)
            elif type(request) in self._handlers:
                answer = self._handlers[type(request)](request, incoming, client)
                self._transport.answer(incoming.route, answer)
            else:
                self._forward(incoming)
        except EscapeError as error:
            self._transport.refuse(incoming.route, error)
        except Exception as error:
            log.exception("unexpected, at '%s'", request.verb)
            self._transport.send_error(incoming.route, error)

    def _register_client(self, hello: requests.RegisterClient, route: bytes) -> State:
        if hello.schema_version != SCHEMA:
            raise RequestRefused(
                f"this server speaks version {SCHEMA}, the client {hello.schema_version}; "
                "use the same version of escape-hw on both sides"
            )
        self._leases.register_client(hello, route)
        return self._state

    def _acquire(
        self, request: requests.AcquireLease, incoming: IncomingRequest, client: RegisteredClient
    ) -> object:
        lease = self._leases.acquire(client, request.take_over)
        self._set_state(self._state)
        return lease

    def _release(
        self, request: requests.ReleaseLease, incoming: IncomingRequest, client: RegisteredClient
    ) -> None:
        self._leases.release(client)
        self._set_state(self._state)

    def _send_latest(self, request: requests.GetLatestSample, incoming: IncomingRequest) -> None:
        if request.stream not in STREAMS:
            raise RequestRefused(f"no stream is called '{request.stream}'; there are {', '.join(STREAMS)}")
        segment = {one.name: one.segment for one in self._state.streams}.get(request.stream)
        head, data = self._sampler.latest(request.stream, segment, request.after)
        self._transport.answer(incoming.route, head, data)

    def _forward(self, incoming: IncomingRequest) -> None:
        """Hand a request to the engine."""
        if self._engine is None or self._engine.has_exited():
            self._handle_without_engine(incoming)
            return
        if isinstance(incoming.request, requests.Shutdown):
            self._stop_requested_s = time.monotonic()
        number = self._next_request_id()
        self._pending[number] = PendingRequest(incoming, time.monotonic())
        self._engine.send({"id": number, "request": _to_document(incoming.request)})

    def _handle_without_engine(self, incoming: IncomingRequest) -> None:
        """What can be done while there is no engine; the mirror is as the guardian left it."""
        if isinstance(incoming.request, requests.Shutdown):
            self._stopping = True
        elif self._engine is not None:
            raise RequestRefused("the engine has died, and its guardian makes the mirror safe; wait a moment")
        elif isinstance(incoming.request, requests.ClearFault):
            self._state = self._state.model_copy(update={"fault": None, "phase": Phase.STARTING})
            self._engine = self._start_engine()
        elif not isinstance(incoming.request, SAFETY_REQUESTS):
            raise RequestRefused("the engine has died; clear the fault to start it again")
        self._transport.answer(incoming.route, None)

    def _next_request_id(self) -> int:
        self._last_request_id += 1
        return self._last_request_id


def _to_document(request: requests.Request) -> dict[str, Any]:
    return request.model_dump(mode="json")


class ClientKeyCheck:
    """Says whether a key is allowed; asked at every connection, so that changes count at once."""

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether the client with this public key is let in."""
        names = [name for name, known in allowed_keys().items() if known == key]
        log.log(
            logging.INFO if names else logging.WARNING, "key %s: %s", key.decode(), names or "not allowed"
        )
        return bool(names)


class Server:
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
        running = find_server(name)
        if running is not None and running.alive:
            raise ConfigError(f"'{name}' is served by process {running.pid} already; stop that one first")
        if running is not None:
            unregister_server(running)
        local = local_endpoint(name, pid)
        tcp = "" if port is None else tcp_endpoint(host, port).requests
        self.listing = ServerListing(name, pid, process_start(pid) or 0, local.requests, local.events, tcp)
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        self._stack.callback(context.term)
        self._transport = ZmqTransport(context)
        try:
            self._stack.callback(unregister_server, self.listing)
            self._stack.callback(self._transport.close)
            self._open(context, local, None if port is None else tcp_endpoint(host, port), host)
        except BaseException:
            self._stack.close()
            raise

    def _open(
        self, context: zmq.Context[zmq.Socket[bytes]], local: Endpoint, tcp: Endpoint | None, host: str
    ) -> None:
        if tcp is None or is_loopback(host):
            self._transport.open(*(one for one in (local, tcp) if one is not None))
            return
        keys = server_keys()
        authenticator = ThreadAuthenticator(context)
        authenticator.start()
        self._stack.callback(authenticator.stop)
        authenticator.configure_curve_callback("escape", ClientKeyCheck())
        self._transport.open(local)
        self._transport.open(tcp, keys=keys)

    def run(self, stop: StopSignal, runs: Path, reads: tuple[Path, ...] = ()) -> None:
        """Serve until told to stop."""
        register_server(self.listing)
        FrontEnd(self._config, self._transport, runs, reads).run(stop)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._stack.close()
