"""The front end: serves the clients, forwards their requests to the engine, and supervises it."""

from __future__ import annotations

import itertools
import logging
import os
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any, Self

import zmq
from zmq.auth.thread import ThreadAuthenticator

from escape_hw.api.procedure import StopSignal
from escape_hw.config.system import SystemConfig
from escape_hw.errors import ConfigError, EscapeError, RequestRefused
from escape_hw.io.provenance import format_utc, get_software_version
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
from escape_hw.remote.source import RENAMED_STREAMS, STREAMS
from escape_hw.remote.state import SCHEMA, FinishedRun, LogLine, Phase, State
from escape_hw.server.frontend.engine_supervisor import EngineSupervisor, PublishedState
from escape_hw.server.frontend.lease import LeaseManager
from escape_hw.server.frontend.transport import IncomingRequest, ZmqTransport
from escape_hw.server.ipc.channel import EngineSetup
from escape_hw.server.ipc.log import ServerLog
from escape_hw.server.safety.journal import ServerJournal
from escape_hw.streams.ring import ReaderCache
from escape_hw.supervision import process_start

log = logging.getLogger(__name__)

_POLL_MS = 50


class FrontEnd:
    """Serves the clients of one system and supervises its engine."""

    def __init__(
        self, config: SystemConfig, transport: ZmqTransport, runs: Path, read_folders: tuple[Path, ...] = ()
    ) -> None:
        self._config, self._transport = config, transport
        self._journal = ServerJournal(config.system.name)
        self._log = ServerLog(
            self._journal.folder / f"{config.system.name}.log", lambda line: transport.publish("log", line)
        )
        self._leases = LeaseManager(config.server.lease_s)
        state = State(
            at_utc=format_utc(), server_pid=os.getpid(), version=get_software_version(),
            system=config.system.name, simulated=config.simulated, seed=config.system.seed,
            notes=self._journal.read_previous_end(), unattended_limit_s=config.server.unattended_s,
        )  # fmt: skip
        self._published = PublishedState(state, self._leases, transport)
        #: Requests that the engine has not answered yet, and when they were forwarded (monotonic seconds).
        self._pending: dict[int, tuple[IncomingRequest, float]] = {}
        self._numbers = itertools.count(1)
        self._readers = ReaderCache()
        self._journal.write(None)
        setup = EngineSetup(config_text=config.to_toml(), runs=runs, read_folders=read_folders)
        self._supervisor = EngineSupervisor(
            config.server, setup, self._journal, self._published,
            on_message=self._on_engine_message, on_exit=self._refuse_pending,
        )  # fmt: skip

    # ------------------------------------------------------------ life
    def run(self, stop: StopSignal) -> None:
        """Serve until ``stop`` is set or a client ends the server; the mirror is flat then."""
        poller = zmq.Poller()
        for socket in self._transport.sockets:
            poller.register(socket, zmq.POLLIN)
        supervisor = self._supervisor
        try:
            while not supervisor.stopping:
                engine = supervisor.running_engine
                if engine is not None:
                    poller.register(engine.connection.fileno(), zmq.POLLIN)
                poller.poll(_POLL_MS)
                if engine is not None:
                    poller.unregister(engine.connection.fileno())
                    supervisor.receive_messages(engine)
                for incoming in self._transport.receive_requests():
                    self._handle_request(incoming)
                self._leases.expire()
                supervisor.check(self._oldest_safety_request_s())
                self._check_abandoned_run()
                if stop.is_set():
                    supervisor.stop()
        finally:
            self._close()

    def _close(self) -> None:
        clean = self._supervisor.close()
        state = self._published.state
        self._transport.publish(
            "state", state.model_copy(update={"phase": Phase.STOPPED, "serial": state.serial + 1})
        )
        if clean:
            self._journal.close()
        self._readers.close()
        self._log.close()

    def _oldest_safety_request_s(self) -> float:
        waiting = [
            since_s for incoming, since_s in self._pending.values()
            if incoming.request.verb in requests.SAFETY_VERBS
        ]  # fmt: skip
        return time.monotonic() - min(waiting) if waiting else 0.0

    def _check_abandoned_run(self) -> None:
        """Abort a procedure that no client has controlled for a while, if there is a limit."""
        state, limit = self._published.state, self._config.server.unattended_s
        abandoned_s, run = self._leases.seconds_without_holder(), state.active_run
        if (
            not limit
            or run is None
            or abandoned_s <= limit
            or state.fault is not None
            or self._leases.lease is not None
        ):
            return
        self._leases.released_s = None
        self._supervisor.make_safe(
            f"'{run.name}' (run {run.id}) was without a client in control for {abandoned_s:.1f} s "
            f"(limit {limit:g} s)",
            "The measured data are saved. Clear the fault, and resume the run if it should continue.",
        )

    # ------------------------------------------------------------ messages of the engine
    def _on_engine_message(self, message: dict[str, Any]) -> None:
        match message:
            case {"reply": number}:
                pending = self._pending.pop(number, None)
                if pending is None:
                    return
                if "error" in message:
                    self._transport.send_error(pending[0].route, message["error"])
                else:
                    self._transport.send_reply(pending[0].route, message["answer"])
            case {"log": line}:
                self._log.add(LogLine.model_validate(line))
            case {"progress": progress}:
                self._transport.publish("progress", progress)
            case {"ended": ended}:
                self._transport.publish("ended", FinishedRun.model_validate(ended))

    def _refuse_pending(self) -> None:
        for incoming, _ in self._pending.values():
            self._transport.send_error(incoming.route, RequestRefused("the engine has ended"))
        self._pending.clear()

    # ------------------------------------------------------------ requests of the clients
    def _handle_request(self, incoming: IncomingRequest) -> None:
        request, route = incoming.request, incoming.route
        try:
            if isinstance(request, requests.RegisterClient):
                self._transport.send_reply(route, self._register(request, route.sender))
                return
            client = self._leases.record_activity(request.client, route.sender)
            if request.verb in requests.LEASE_VERBS:
                self._leases.require(client)
            if request.verb in requests.SAFETY_VERBS:
                log.warning("%s: %s", client.description, request.verb.replace("_", " "))
            match request:
                case requests.GetLatestSample():
                    self._transport.send_reply(route, *self._latest(request))
                case requests.GetLog():
                    lines = self._log.after(request.after, request.count)
                    self._transport.send_reply(route, [line.model_dump(mode="json") for line in lines])
                case requests.AcquireLease():
                    lease = self._leases.acquire(client, request.take_over)
                    self._published.update()
                    self._transport.send_reply(route, lease)
                case requests.PlainRequest(verb="release_lease"):
                    self._leases.release(client)
                    self._published.update()
                    self._transport.send_reply(route, None)
                case requests.PlainRequest(verb="state"):
                    self._transport.send_reply(route, self._published.state)
                case requests.PlainRequest(verb="heartbeat"):
                    self._transport.send_reply(route, None)
                case _:
                    self._forward(incoming)
        except EscapeError as error:
            self._transport.refuse(route, error)
        except Exception as error:
            log.exception("unexpected exception at '%s'", request.verb)
            self._transport.send_error(route, error)

    def _register(self, registration: requests.RegisterClient, route: bytes) -> State:
        if registration.schema_version != SCHEMA:
            raise RequestRefused(
                f"this server speaks version {SCHEMA} of the protocol, the client version "
                f"{registration.schema_version}; use the same version of escape-hw on both sides"
            )
        self._leases.register_client(registration, route)
        return self._published.state

    def _latest(self, request: requests.GetLatestSample) -> tuple[dict[str, Any] | None, bytes | None]:
        """Header and bytes of a stream's newest entry; ``None`` when there is none newer."""
        stream = RENAMED_STREAMS.get(request.stream, request.stream)
        if stream not in STREAMS:
            raise RequestRefused(f"there is no stream '{stream}'; there are {', '.join(STREAMS)}")
        segment = {one.name: one.segment for one in self._published.state.streams}.get(stream)
        reader = self._readers.reader(stream, segment)
        sample = None if reader is None else reader.latest(request.after)
        if sample is None:
            return None, None
        head = {
            "index": sample.index, "exposed_ns": sample.exposed_ns, "arrived_ns": sample.arrived_ns,
            "dtype": sample.data.dtype.str, "shape": list(sample.data.shape), "meta": dict(sample.meta),
        }  # fmt: skip
        return head, sample.data.tobytes()

    def _forward(self, incoming: IncomingRequest) -> None:
        """Forward a request to the engine."""
        engine = self._supervisor.running_engine
        if engine is None:
            self._handle_without_engine(incoming)
            return
        if incoming.request.verb == "shutdown":
            self._supervisor.note_stop_request()
        number = next(self._numbers)
        self._pending[number] = (incoming, time.monotonic())
        engine.send({"id": number, "request": incoming.request.model_dump(mode="json")})

    def _handle_without_engine(self, incoming: IncomingRequest) -> None:
        """Answer a request while there is no engine; the fail-safe process has made the mirror safe."""
        verb, supervisor = incoming.request.verb, self._supervisor
        if verb == "shutdown":
            supervisor.stopping = True
        elif not supervisor.has_ended:
            raise RequestRefused(
                "the engine has died; the fail-safe process makes the mirror safe; try again"
            )
        elif verb == "clear_fault":
            self._published.state = self._published.state.model_copy(
                update={"fault": None, "phase": Phase.STARTING}
            )
            supervisor.start()
        elif verb not in requests.SAFETY_VERBS:
            raise RequestRefused("the engine has died; clear the fault to start it again")
        self._transport.send_reply(incoming.route, None)


class ClientKeyCheck:
    """Checks client keys at every connection, so that changes are effective at once."""

    def callback(self, domain: str, key: bytes) -> bool:
        """Whether the client with this public key may connect."""
        names = [name for name, known in allowed_keys().items() if known == key]
        log.log(
            logging.INFO if names else logging.WARNING, "key %s: %s", key.decode(), names or "not allowed"
        )
        return bool(names)


class Server:
    """A listening server with its sockets and its entry in the user's list; a context manager.

    It listens on local sockets and, with a ``port``, on TCP as well. ConfigError: the system is served
    already, or the address is not available.
    """

    def __init__(self, config: SystemConfig, host: str = "127.0.0.1", port: int | None = None) -> None:
        self._config, self._stack = config, ExitStack()
        name, pid = config.system.name, os.getpid()
        running = find_server(name)
        if running is not None and running.alive:
            raise ConfigError(f"'{name}' is already served by process {running.pid}; stop that server first")
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

    def run(self, stop: StopSignal, runs: Path, read_folders: tuple[Path, ...] = ()) -> None:
        """Serve until ``stop`` is set; parameters as for :class:`FrontEnd`."""
        register_server(self.listing)
        FrontEnd(self._config, self._transport, runs, read_folders).run(stop)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._stack.close()
