"""Answers requests that the front end forwards, or hands them to the main thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import ValidationError

from escape_hw.errors import ConfigError, EscapeError, RequestRefused
from escape_hw.remote import requests
from escape_hw.remote.requests import error_to_document
from escape_hw.server.engine.bench_owner import BenchOwner
from escape_hw.server.engine.bench_status import geometry_of
from escape_hw.server.engine.loop import LoopRunner
from escape_hw.server.engine.planning import ProcedurePlanner
from escape_hw.server.engine.procedures import ProcedureRegistry, needs_loop
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.publisher import StreamPublisher
from escape_hw.server.engine.recording import TelemetryRecording
from escape_hw.server.engine.runner import LOOP_IS_RESTORED, ProcedureRunner
from escape_hw.server.engine.state import EngineState
from escape_hw.server.engine.state_publisher import StatePublisher

log = logging.getLogger(__name__)

#: Returned by a handler whose reply is sent later.
DEFERRED = object()
#: Answer to a safety request when nothing has to be made flat.
_NO_FAULT = {"fault": None}


@dataclass(frozen=True, slots=True)
class Services:
    """What the handlers of requests use."""

    state: EngineState
    state_publisher: StatePublisher
    publisher: StreamPublisher
    product_store: ProductStore
    procedures: ProcedureRegistry
    planner: ProcedurePlanner
    recording: TelemetryRecording
    owner: BenchOwner
    loop_runner: LoopRunner
    procedure_runner: ProcedureRunner


class RequestHandler:
    """Dispatches the messages of the front end; for one thread."""

    def __init__(
        self,
        services: Services,
        send: Callable[[Mapping[str, Any]], object],
        request_stop: Callable[[], object],
    ) -> None:
        self._services, self._send, self._request_stop = services, send, request_stop
        self._handlers: dict[type[requests.Request], Callable[[Any, int], object]] = {
            requests.GetGeometry: self._geometry,
            requests.GetProcedures: self._procedures,
            requests.PlanProcedure: self._plan,
            requests.OpenLoop: self._open_loop,
            requests.Flatten: self._flatten,
            requests.AbortProcedure: self._abort,
            requests.StartProcedure: self._start,
            requests.PauseProcedure: lambda request, number: services.state.pause(),
            requests.ResumeProcedure: lambda request, number: services.state.resume(),
            requests.CloseLoop: self._close_loop,
            requests.SetLoop: lambda request, number: services.loop_runner.change(request),
            requests.LoadProduct: self._load_product,
            requests.SetRecording: self._set_recording,
            requests.ClearFault: self._clear_fault,
            requests.Shutdown: lambda request, number: request_stop(),
        }

    def run(self, messages: Iterable[Mapping[str, Any]]) -> None:
        """Handle messages until the front end closes the channel; the engine stops then."""
        try:
            for message in messages:
                self.handle(message)
        except ValueError as error:
            log.error("the front end sent a malformed message: %s", error)
        log.warning("the connection to the front end ended: stopping, mirror flat")
        self._request_stop()

    def handle(self, message: Mapping[str, Any]) -> None:
        """Handle one message."""
        match message:
            case {"stop": _}:
                self._request_stop()
            case {"make_safe": {"reason": reason, "remedy": remedy}}:
                self._services.owner.request_safe_state(str(reason), str(remedy))
            case {"id": number, "request": document}:
                self._handle_request(number, document)
            case _:
                pass  # a heartbeat, which the channel has noted

    def _handle_request(self, number: int, document: object) -> None:
        try:
            request = requests.REQUESTS.validate_python(document)
            answer = self._handlers[type(request)](request, number)
        except (KeyError, ValidationError) as error:
            self._reply(number, error=RequestRefused(f"the engine has no such request: {error}"))
        except Exception as error:
            if not isinstance(error, (ConfigError, RequestRefused)):
                log.warning("a request failed: %s: %s", type(error).__name__, error)
            self._reply(number, error=error)
        else:
            if answer is not DEFERRED:
                if isinstance(request, requests.STATE_CHANGING_REQUESTS):
                    # The new state is published before the request is confirmed.
                    self._services.state_publisher.publish()
                self._reply(number, answer=answer)

    def _reply(self, number: int, answer: object = None, error: BaseException | None = None) -> None:
        outcome = {"answer": answer} if error is None else {"error": error_to_document(error)}
        self._send({"reply": number, **outcome})

    # ------------------------------------------------------------ read only
    def _geometry(self, request: requests.GetGeometry, number: int) -> object:
        bench = self._services.owner.bench
        if not bench.dm.is_open:
            raise RequestRefused("the devices are not open")
        return geometry_of(bench, self._services.publisher.grid).model_dump(mode="json")

    def _procedures(self, request: requests.GetProcedures, number: int) -> object:
        return [entry.model_dump(mode="json") for entry in self._services.procedures.entries]

    def _plan(self, request: requests.PlanProcedure, number: int) -> object:
        s = self._services
        arguments = s.procedures.arguments(request.procedure, request.arguments)
        s.procedures.task(request.procedure, request.arguments, s.product_store)
        if not s.owner.bench.is_open:
            raise RequestRefused("the devices are not open; a plan needs their settings")
        plan = s.planner.plan(request.procedure, arguments)
        if s.state.snapshot.loop_control is not None:
            note = LOOP_IS_RESTORED if needs_loop(request.procedure, arguments) else "open the loop first"
            plan = plan.model_copy(update={"warnings": (*plan.warnings, f"the loop is closed: {note}")})
        return plan.model_dump(mode="json")

    # ------------------------------------------------------------ safety
    def _flatten(self, request: requests.Flatten, number: int) -> object:
        self._services.state.request_stop()
        return self._reply_when_flat(number)

    def _open_loop(self, request: requests.OpenLoop, number: int) -> object:
        return self._reply_when_flat(number) if self._services.state.request_open_loop() else _NO_FAULT

    def _abort(self, request: requests.AbortProcedure, number: int) -> object:
        return self._reply_when_flat(number) if self._services.state.request_abort() else _NO_FAULT

    def _reply_when_flat(self, number: int) -> object:
        self._services.owner.reply_when_flat(lambda answer: self._reply(number, answer))
        return DEFERRED

    # ------------------------------------------------------------ control
    def _start(self, request: requests.StartProcedure, number: int) -> object:
        s = self._services
        arguments = s.procedures.arguments(request.procedure, request.arguments)
        loop = needs_loop(request.procedure, arguments)
        s.state.check_can_start(loop)
        task = s.procedures.task(request.procedure, request.arguments, s.product_store)
        return s.procedure_runner.start(task, request.procedure, arguments, loop)

    def _close_loop(self, request: requests.CloseLoop, number: int) -> object:
        def on_closed(error: EscapeError | None) -> None:
            self._reply(number, error=error)

        self._services.loop_runner.close(request, on_closed)
        return DEFERRED

    def _load_product(self, request: requests.LoadProduct, number: int) -> object:
        return self._services.product_store.load(request.path, request.name).model_dump(mode="json")

    def _set_recording(self, request: requests.SetRecording, number: int) -> object:
        return self._services.recording.set_recording(request.on).model_dump(mode="json")

    def _clear_fault(self, request: requests.ClearFault, number: int) -> object:
        s = self._services
        if s.state.snapshot.fault is None:
            return None

        def clear() -> None:
            s.owner.clear_fault()
            s.state_publisher.publish()
            self._reply(number)

        s.owner.post(clear)
        return DEFERRED
