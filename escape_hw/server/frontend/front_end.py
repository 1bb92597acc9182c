"""The front end: serves the clients, forwards their requests to the engine, and supervises it."""

from __future__ import annotations

import itertools
import logging
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import zmq
from zmq.auth.thread import ThreadAuthenticator

from escape_hw.api.procedure import StopSignal
from escape_hw.config.system import SystemConfig
from escape_hw.errors import EscapeError, RequestRefused
from escape_hw.io.night_log import NightEntry
from escape_hw.io.provenance import format_utc, get_software_version
from escape_hw.remote import requests
from escape_hw.remote.address import Endpoint, is_loopback, tcp_endpoint
from escape_hw.remote.keys import allowed_keys, server_keys
from escape_hw.remote.source import RENAMED_STREAMS, STREAMS
from escape_hw.remote.state import SCHEMA, FinishedRun, LogLine, Phase, State
from escape_hw.server.frontend.engine_supervisor import EngineSupervisor, PublishedState
from escape_hw.server.frontend.lease import LeaseManager
from escape_hw.server.frontend.night_log import NightLog
from escape_hw.server.frontend.transport import IncomingRequest, ZmqTransport
from escape_hw.server.ipc.channel import EngineSetup
from escape_hw.server.ipc.log import ServerLog
from escape_hw.server.safety.journal import ServerJournal
from escape_hw.streams.ring import ReaderCache

log = logging.getLogger(__name__)

#: Period of the main loop, and while replies wait for slow clients.
_POLL_MS, _BUSY_POLL_MS = 50, 5
#: Requests of one connection that may wait for the engine; further ones are refused.
_MAX_PENDING = 20


class FrontEnd:
    """Serves the clients of one system and supervises its engine.

    ``server_pid`` is the process of the server. Log lines and states are numbered from ``first_number``.
    """

    def __init__(
        self,
        config: SystemConfig,
        transport: ZmqTransport,
        runs: Path,
        read_folders: tuple[Path, ...],
        server_pid: int,
        first_number: int = 0,
    ) -> None:
        self._config, self._transport = config, transport
        self._journal = ServerJournal(config.system.name)
        self._log = ServerLog(
            self._journal.folder / f"{config.system.name}.log",
            lambda line: transport.publish("log", line),
            first_number,
        )
        self._leases = LeaseManager(config.server.lease_s)
        transport.on_disconnect = self._leases.remove_connection
        state = State(
            serial=first_number, at_utc=format_utc(), server_pid=server_pid, version=get_software_version(),
            system=config.system.name, simulated=config.simulated, seed=config.system.seed,
            notes=self._journal.read_previous_end(), products=self._journal.products,
            unattended_limit_s=config.server.unattended_s,
        )  # fmt: skip
        self._published = PublishedState(state, self._leases, transport, self._log)
        self._night_log = NightLog(config, runs, self._publish_night_entry)
        self._night_log.start(state.notes)
        #: Requests that the engine has not answered yet, and when they were forwarded (monotonic seconds).
        self._pending: dict[int, tuple[IncomingRequest, float]] = {}
        self._numbers = itertools.count(1)
        self._readers = ReaderCache()
        self._journal.write(None)
        setup = EngineSetup(
            config_text=config.to_toml(), runs=runs, read_folders=read_folders,
            first_run_id=self._journal.last_run_id + 1,
        )  # fmt: skip
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
                poller.poll(_BUSY_POLL_MS if self._transport.flush() else _POLL_MS)
                if engine is not None:
                    poller.unregister(engine.connection.fileno())
                    supervisor.receive_messages(engine)
                for incoming in self._transport.receive_requests():
                    self._handle_request(incoming)
                self._log.flush()
                self._leases.expire()
                self._night_log.update(self._published.state)
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
        self._night_log.close(clean)
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

    def _publish_night_entry(self, entry: NightEntry) -> None:
        self._transport.publish("night", entry)
        self._published.last_night_entry = entry.number

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
                finished = FinishedRun.model_validate(ended)
                self._transport.publish("ended", finished)
                self._night_log.update(self._published.state)
                self._night_log.log_run(finished)

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
            if request.verb in requests.SAFETY_VERBS:
                self._forward_safety_request(incoming)
                return
            client = self._leases.record_activity(request.client, route.sender)
            if request.verb in requests.LEASE_VERBS:
                self._leases.require(client)
            match request:
                case requests.GetLatestSample():
                    self._transport.send_reply(route, *self._latest(request))
                case requests.GetLog():
                    lines = self._log.after(request.after, request.count)
                    self._transport.send_reply(route, [line.model_dump(mode="json") for line in lines])
                case requests.GetNightLog():
                    entries = self._night_log.after(request.after, request.count)
                    self._transport.send_reply(route, [entry.model_dump(mode="json") for entry in entries])
                case requests.AddNote():
                    author = self._leases.describe_sender(request.client, route.sender)
                    self._transport.send_reply(route, self._night_log.add(request.kind, request.text, author))
                case requests.AcquireLease():
                    lease = self._leases.acquire(client, request.take_over)
                    self._published.update()
                    self._transport.send_reply(route, lease)
                case requests.PlainRequest(verb="release_lease"):
                    self._leases.release(client)
                    self._published.update()
                    self._transport.send_reply(route, None)
                case requests.PlainRequest(verb="goodbye"):
                    self._leases.remove(client)
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

    def _forward_safety_request(self, incoming: IncomingRequest) -> None:
        """Forward a safety request, from any connection: it needs neither registration nor control."""
        verb, route = incoming.request.verb, incoming.route
        sender = self._leases.describe_sender(incoming.request.client, route.sender)
        log.warning("%s: %s", sender, verb.replace("_", " "))
        self._forward(incoming)

    def _forward(self, incoming: IncomingRequest) -> None:
        """Forward a request to the engine."""
        engine = self._supervisor.running_engine
        if engine is None:
            self._handle_without_engine(incoming)
            return
        if incoming.request.verb == "shutdown":
            self._supervisor.note_stop_request()
        sender = incoming.route.sender
        if sum(one.route.sender == sender for one, _ in self._pending.values()) >= _MAX_PENDING:
            raise RequestRefused(f"{_MAX_PENDING} requests of this connection wait already; wait for replies")
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


@contextmanager
def listening_transport(local: Endpoint, host: str, port: int | None) -> Iterator[ZmqTransport]:
    """A transport that listens on local sockets and, with a ``port``, on TCP as well.

    ConfigError: an address is not available.
    """
    with ExitStack() as stack:
        context: zmq.Context[zmq.Socket[bytes]] = zmq.Context()
        stack.callback(context.term)
        transport = ZmqTransport(context)
        stack.callback(transport.close)
        if port is None:
            transport.open(local)
        elif is_loopback(host):
            transport.open(local, tcp_endpoint(host, port))
        else:
            keys = server_keys()
            authenticator = ThreadAuthenticator(context)
            authenticator.start()
            stack.callback(authenticator.stop)
            authenticator.configure_curve_callback("escape", ClientKeyCheck())
            transport.open(local)
            transport.open(tcp_endpoint(host, port), keys=keys)
        yield transport
