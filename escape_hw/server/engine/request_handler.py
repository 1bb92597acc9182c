"""Answers requests that the front end has checked and forwarded, or forwards them to the main thread."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any

from pydantic import ValidationError

from escape_hw.errors import ConfigError, DeviceError, EscapeError, RequestRefused, SettingRejected
from escape_hw.remote import requests
from escape_hw.remote.requests import error_to_document
from escape_hw.remote.state import OffsetsState
from escape_hw.server.engine.bench_owner import REOPEN_REMEDY, BenchOwner
from escape_hw.server.engine.camera_settings import CameraControl
from escape_hw.server.engine.offsets import OffsetControl
from escape_hw.server.engine.poke import PokeRunner
from escape_hw.server.engine.procedures import ProcedurePlanner, ProcedureRegistry, needs_loop
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.publisher import TelemetryRecording
from escape_hw.server.engine.runner import LOOP_IS_RESTORED, LoopRunner, ProcedureRunner
from escape_hw.server.engine.state_publisher import geometry_of

log = logging.getLogger(__name__)

#: Returned by a handler whose reply is sent later.
DEFERRED = object()
#: Answer to a safety request when nothing has to be made flat.
_NO_FAULT = {"fault": None}


class RequestHandler:
    """Dispatches the messages of the front end; for one thread."""

    def __init__(
        self,
        owner: BenchOwner,
        loop_runner: LoopRunner,
        procedure_runner: ProcedureRunner,
        product_store: ProductStore,
        recording: TelemetryRecording,
        request_stop: Callable[[], object],
        offsets: OffsetControl,
    ) -> None:
        self._owner, self._state, self._request_stop = owner, owner.state, request_stop
        self._loop_runner, self._procedure_runner = loop_runner, procedure_runner
        self._product_store, self._recording = product_store, recording
        self._procedures = ProcedureRegistry(owner.bench.config)
        self._planner = ProcedurePlanner(owner.bench)
        self._offsets = offsets
        self._cameras, self._poke_runner = CameraControl(owner, loop_runner), PokeRunner(owner)

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
                self._owner.request_safe_state(str(reason), str(remedy))
            case {"id": number, "request": document}:
                self._handle_request(number, document)
            case _:
                pass  # a heartbeat, which the channel has noted

    def _handle_request(self, number: int, document: object) -> None:
        try:
            request = requests.REQUESTS.validate_python(document)
            answer = self._answer(request, number)
        except ValidationError as error:
            self._reply(number, error=RequestRefused(f"the engine has no such request: {error}"))
        except Exception as error:
            if not isinstance(error, (ConfigError, RequestRefused, SettingRejected)):
                log.warning("a request failed: %s: %s", type(error).__name__, error)
            self._reply(number, error=error)
        else:
            if answer is not DEFERRED:
                if request.verb in requests.STATE_CHANGING_VERBS:
                    # The new state is published before the request is confirmed.
                    self._owner.state_publisher.publish()
                self._reply(number, answer=answer)

    def _reply(self, number: int, answer: object = None, error: BaseException | None = None) -> None:
        outcome = {"answer": answer} if error is None else {"error": error_to_document(error)}
        self._owner.send({"reply": number, **outcome})

    def _answer(self, request: requests.AnyRequest, number: int) -> object:
        """The answer, or :data:`DEFERRED`."""
        match request:
            case requests.PlainRequest():
                return self._answer_plain(request.verb, number)
            case requests.ProcedureRequest(verb="plan"):
                return self._plan(request)
            case requests.ProcedureRequest():
                return self._start(request)
            case requests.CloseLoop():
                self._loop_runner.close(request, lambda error: self._reply(number, error=error))
                return DEFERRED
            case requests.SetLoop():
                self._loop_runner.change(request)
            case requests.LoadProduct():
                return self._product_store.load(request.path, request.name).model_dump(mode="json")
            case requests.SetRecording():
                return self._recording.set_recording(
                    request.on, images=request.images, seconds=request.seconds
                ).model_dump(mode="json")
            case requests.CameraRequest(verb="check_camera"):
                return self._cameras.plan(request).model_dump(mode="json")
            case requests.CameraRequest():
                return self._set_camera(request, number)
            case requests.PokeRequest(verb="check_poke"):
                return self._poke_runner.plan(request).model_dump(mode="json")
            case requests.PokeRequest():
                self._poke_runner.start(request, lambda error: self._reply(number, error=error))
                return DEFERRED
            case requests.OffsetsRequest():
                self._offsets.handle(request, partial(self._reply_offsets, number))
                return DEFERRED
            case _:
                raise RequestRefused(f"the engine has no request '{request.verb}'")
        return None

    def _reply_offsets(self, number: int, state: OffsetsState | None, error: EscapeError | None) -> None:
        if state is not None:
            self._owner.state_publisher.publish()
        self._reply(number, None if state is None else state.model_dump(mode="json"), error)

    def _set_camera(self, request: requests.CameraRequest, number: int) -> object:
        """Change a camera in the main thread, or the science camera of a closed loop at once."""
        if self._cameras.is_science_in_loop(request):
            return self._cameras.change(request).model_dump(mode="json")
        plan = self._cameras.plan(request)
        if plan.refusal:
            raise RequestRefused(plan.refusal)

        def change() -> None:
            try:
                answer = self._cameras.change(request).model_dump(mode="json")
            except EscapeError as error:
                if isinstance(error, DeviceError) and not isinstance(error, SettingRejected):
                    self._owner.make_safe(str(error), REOPEN_REMEDY, error.device)
                self._reply(number, error=error)
                return
            self._owner.state_publisher.publish()
            self._reply(number, answer)

        self._owner.post(change)
        return DEFERRED

    def _answer_plain(self, verb: str, number: int) -> object:
        state = self._state
        match verb:
            case "geometry":
                return self._geometry()
            case "procedures":
                return [entry.model_dump(mode="json") for entry in self._procedures.entries]
            case "flatten":
                state.request_stop()
                return self._reply_when_flat(number)
            case "open_loop":
                return self._reply_when_flat(number) if state.request_open_loop() else _NO_FAULT
            case "abort_procedure":
                return self._reply_when_flat(number) if state.request_abort() else _NO_FAULT
            case "pause_procedure":
                state.pause()
            case "resume_procedure":
                state.resume()
            case "clear_fault":
                return self._clear_fault(number)
            case "shutdown":
                self._request_stop()
            case _:
                raise RequestRefused(f"the engine has no request '{verb}'")
        return None

    def _geometry(self) -> object:
        bench = self._owner.bench
        if not bench.dm.is_open:
            raise RequestRefused("the devices are not open")
        return geometry_of(bench, self._owner.publisher.grid).model_dump(mode="json")

    def _plan(self, request: requests.ProcedureRequest) -> object:
        arguments = self._procedures.arguments(request.procedure, request.arguments)
        self._procedures.task(request.procedure, request.arguments, self._product_store)
        if not self._owner.bench.is_open:
            raise RequestRefused("the devices are not open; a plan needs their settings")
        plan = self._planner.plan(request.procedure, arguments)
        if self._state.snapshot.loop_control is not None:
            note = LOOP_IS_RESTORED if needs_loop(request.procedure, arguments) else "open the loop first"
            plan = plan.model_copy(update={"warnings": (*plan.warnings, f"the loop is closed: {note}")})
        return plan.model_dump(mode="json")

    def _start(self, request: requests.ProcedureRequest) -> int:
        arguments = self._procedures.arguments(request.procedure, request.arguments)
        loop = needs_loop(request.procedure, arguments)
        self._state.check_can_start(loop)
        task = self._procedures.task(request.procedure, request.arguments, self._product_store)
        return self._procedure_runner.start(task, request.procedure, arguments, loop)

    def _reply_when_flat(self, number: int) -> object:
        self._owner.reply_when_flat(lambda answer: self._reply(number, answer))
        return DEFERRED

    def _clear_fault(self, number: int) -> object:
        if self._state.snapshot.fault is None:
            return None

        def clear() -> None:
            self._owner.clear_fault()
            self._owner.state_publisher.publish()
            self._reply(number)

        self._owner.post(clear)
        return DEFERRED
