"""What is asked of the engine, answered or handed to its main thread, in a thread of its own."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from escape_hw.errors import ConfigError, RequestRefused
from escape_hw.remote import requests
from escape_hw.remote.requests import error_to_document
from escape_hw.server.engine import runner as jobs
from escape_hw.server.engine.bench_status import geometry_of
from escape_hw.server.engine.procedures import needs_loop

if TYPE_CHECKING:
    from escape_hw.server.engine.main import Engine

log = logging.getLogger(__name__)


class DeferredReply:
    """An answer that comes when the work is done."""


DEFERRED = DeferredReply()


class RequestHandler:
    """Takes the front's messages.

    Parameters
    ----------
    engine
        Whose desk it is.
    messages
        What arrives; its end means that the front has gone.
    """

    def __init__(self, engine: Engine, messages: Iterator[dict[str, Any]]) -> None:
        self._engine, self._messages = engine, messages
        self._last_message_s = time.monotonic()
        self._handlers: dict[type[requests.Request], Callable[[Any, int], object]] = {
            requests.GetGeometry: self._geometry,
            requests.GetProcedures: self._procedures,
            requests.PlanProcedure: self._check,
            requests.OpenLoop: self._open_loop,
            requests.Flatten: self._flatten,
            requests.AbortProcedure: self._abort,
            requests.StartProcedure: self._start,
            requests.PauseProcedure: self._pause,
            requests.ResumeProcedure: self._resume,
            requests.CloseLoop: self._close_loop,
            requests.SetLoop: self._set_loop,
            requests.LoadProduct: self._load_product,
            requests.SetRecording: self._record,
            requests.ClearFault: self._clear_fault,
            requests.Shutdown: self._shutdown,
        }

    def start(self) -> None:
        """Begin to answer."""
        threading.Thread(target=self._run, name="desk", daemon=True).start()
        threading.Thread(target=self._watch_for_silence, name="silence", daemon=True).start()

    def _run(self) -> None:
        try:
            for message in self._messages:
                self._last_message_s = time.monotonic()
                self._handle(message)
        except ValueError as error:
            log.error("the front sent what is no message: %s", error)
        log.warning("the front is gone: stopping, mirror flat")
        self._engine.request_stop()

    def _watch_for_silence(self) -> None:
        limit = self._engine.setup.silence_s
        while True:
            time.sleep(limit / 5)
            silent = time.monotonic() - self._last_message_s
            if silent <= limit or self._engine.engine_state.fault is not None:
                continue
            # On a busy machine, or at a long request, it may be this side that has not listened.
            if not self._engine.channel.has_unread:
                jobs.make_safe_now(
                    self._engine, f"the server's front was silent for {silent:.0f} s (limit {limit:g} s)"
                )

    def _handle(self, message: dict[str, Any]) -> None:
        if "end" in message:
            self._engine.request_stop()
            return
        if "fault" in message:
            jobs.make_safe_now(self._engine, str(message["fault"]), str(message.get("way_out", "")))
            return
        number = message.get("id")
        if number is None:
            return  # a sign of life
        try:
            request = requests.REQUESTS.validate_python(message["request"])
            answer = self._handlers[type(request)](request, number)
        except (KeyError, ValidationError) as error:
            self._reply(number, error=RequestRefused(f"the engine does not know this request: {error}"))
        except Exception as error:
            if not isinstance(error, (ConfigError, RequestRefused)):
                log.warning("a request failed: %s: %s", type(error).__name__, error)
            self._reply(number, error=error)
        else:
            if answer is not DEFERRED:
                if isinstance(request, requests.STATE_CHANGING_REQUESTS):
                    # What was done is told before it is confirmed.
                    self._engine.state_publisher.publish()
                self._reply(number, answer=answer)

    def _reply(self, number: int, answer: object = None, error: BaseException | None = None) -> None:
        outcome = {"answer": answer} if error is None else {"error": error_to_document(error)}
        self._engine.channel.post({"reply": number, **outcome})

    # ------------------------------------------------------------ to look
    def _geometry(self, request: requests.GetGeometry, number: int) -> object:
        if not self._engine.bench.dm.is_open:
            raise RequestRefused("the devices are not open")
        return geometry_of(self._engine.bench, self._engine.publisher.grid).model_dump(mode="json")

    def _procedures(self, request: requests.GetProcedures, number: int) -> object:
        return [entry.model_dump(mode="json") for entry in self._engine.procedures.entries]

    def _check(self, request: requests.PlanProcedure, number: int) -> object:
        engine = self._engine
        arguments = engine.procedures.arguments(request.procedure, request.arguments)
        engine.procedures.task(request.procedure, request.arguments, engine.product_store)
        if not engine.bench.is_open:
            raise RequestRefused("the devices are not open; nothing can be planned before they are")
        plan = engine.planner.plan(request.procedure, arguments)
        if engine.engine_state.loop_control is not None:
            loop_note = jobs.LOOP_IS_RESTORED if needs_loop(request.procedure, arguments) else "open the loop first"
            plan = plan.model_copy(update={"warnings": (*plan.warnings, f"the loop is closed: {loop_note}")})
        return plan.model_dump(mode="json")

    # ------------------------------------------------------------ safety
    def _open_loop(self, request: requests.OpenLoop, number: int) -> object:
        engine = self._engine
        with engine.engine_state.lock:
            runs = engine.engine_state.running is not None
            if runs and not engine.engine_state.needs_loop:
                return {"fault": None}  # nothing is closed, and the procedure moves the mirror
            engine.engine_state.stop.set()
        engine.reply_when_flat(number)
        return DEFERRED

    def _flatten(self, request: requests.Flatten, number: int) -> object:
        with self._engine.engine_state.lock:
            self._engine.engine_state.stop.set()
        self._engine.reply_when_flat(number)
        return DEFERRED

    def _abort(self, request: requests.AbortProcedure, number: int) -> object:
        engine_state = self._engine.engine_state
        with engine_state.lock:
            if engine_state.running is None:
                return {"fault": None}
            engine_state.stop.set()
        self._engine.reply_when_flat(number)
        return DEFERRED

    # ------------------------------------------------------------ to write
    def _start(self, request: requests.StartProcedure, number: int) -> object:
        engine = self._engine
        with engine.engine_state.lock:
            arguments = engine.procedures.arguments(request.procedure, request.arguments)
            loop = needs_loop(request.procedure, arguments)
            loop_before = jobs.loop_to_restore(engine) if loop else None
            if loop_before is None:
                engine.engine_state.require_idle()
            task = engine.procedures.task(request.procedure, request.arguments, engine.product_store)
            config = jobs.config_of_task(engine, task)
            task.load(config, self._engine.bench.simulated)
            run = engine.next_run
            engine.next_run += 1
            jobs.begin_run(engine, run, request.procedure, arguments, loop)
        engine.post(lambda: jobs.run_task(engine, task, config, loop_before))
        return run

    def _pause(self, request: requests.PauseProcedure, number: int) -> object:
        engine_state = self._engine.engine_state
        if engine_state.running is None:
            raise RequestRefused("nothing is running")
        if engine_state.needs_loop:
            raise RequestRefused(
                f"'{engine_state.running.name}' works in closed loop and cannot be halted; abort it"
            )
        engine_state.paused = True
        return None

    def _resume(self, request: requests.ResumeProcedure, number: int) -> object:
        if self._engine.engine_state.running is None:
            raise RequestRefused("nothing is running")
        self._engine.engine_state.paused = False
        return None

    def _close_loop(self, request: requests.CloseLoop, number: int) -> object:
        engine = self._engine
        with engine.engine_state.lock:
            engine.engine_state.require_idle()
            jobs.close_loop(engine, request, lambda error: self._reply(number, error=error))
        return DEFERRED

    def _set_loop(self, request: requests.SetLoop, number: int) -> object:
        engine = self._engine
        with engine.engine_state.lock:
            jobs.change_loop_settings(engine, request)
        return None

    def _load_product(self, request: requests.LoadProduct, number: int) -> object:
        return self._engine.product_store.load(request.path, request.name).model_dump(mode="json")

    def _record(self, request: requests.SetRecording, number: int) -> object:
        return self._engine.telemetry.set_recording(request.on).model_dump(mode="json")

    def _clear_fault(self, request: requests.ClearFault, number: int) -> object:
        engine = self._engine
        if engine.engine_state.fault is None:
            return None

        def clear() -> None:
            engine.clear_fault()
            engine.state_publisher.publish()
            self._reply(number)

        engine.post(clear)
        return DEFERRED

    def _shutdown(self, request: requests.Shutdown, number: int) -> object:
        self._engine.request_stop()
        return None
