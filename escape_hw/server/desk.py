"""What is asked of the engine, answered or handed to its main thread, in a thread of its own."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any

from pydantic import ValidationError

from escape_hw.errors import ConfigError, RequestRefused
from escape_hw.remote import requests as ask
from escape_hw.remote.faults import to_wire
from escape_hw.server import jobs
from escape_hw.server.offers import needs_loop
from escape_hw.server.views import geometry_of

if TYPE_CHECKING:
    from escape_hw.server.engine import Engine

log = logging.getLogger(__name__)


class Later:
    """An answer that comes when the work is done."""


LATER = Later()


class Desk:
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
        self._heard = time.monotonic()
        self._answers: dict[type[ask.Request], Callable[[Any, int], object]] = {
            ask.GetGeometry: self._geometry,
            ask.GetProcedures: self._procedures,
            ask.Check: self._check,
            ask.OpenLoop: self._open_loop,
            ask.Flatten: self._flatten,
            ask.Abort: self._abort,
            ask.Start: self._start,
            ask.Pause: self._pause,
            ask.Resume: self._resume,
            ask.CloseLoop: self._close_loop,
            ask.SetLoop: self._set_loop,
            ask.LoadProduct: self._load_product,
            ask.Record: self._record,
            ask.ClearFault: self._clear_fault,
            ask.Shutdown: self._shutdown,
        }

    def start(self) -> None:
        """Begin to answer."""
        threading.Thread(target=self._run, name="desk", daemon=True).start()
        threading.Thread(target=self._listen_for_silence, name="silence", daemon=True).start()

    def _run(self) -> None:
        try:
            for message in self._messages:
                self._heard = time.monotonic()
                self._take(message)
        except ValueError as error:
            log.error("the front sent what is no message: %s", error)
        log.warning("the front is gone: stopping, mirror flat")
        self._engine.end()

    def _listen_for_silence(self) -> None:
        limit = self._engine.setup.silence_s
        while True:
            time.sleep(limit / 5)
            silent = time.monotonic() - self._heard
            if silent <= limit or self._engine.board.fault is not None:
                continue
            # On a busy machine, or at a long request, it may be this side that has not listened.
            if not self._engine.channel.waiting:
                jobs.make_safe_now(
                    self._engine, f"the server's front was silent for {silent:.0f} s (limit {limit:g} s)"
                )

    def _take(self, message: dict[str, Any]) -> None:
        if "end" in message:
            self._engine.end()
            return
        if "fault" in message:
            jobs.make_safe_now(self._engine, str(message["fault"]), str(message.get("way_out", "")))
            return
        number = message.get("id")
        if number is None:
            return  # a sign of life
        try:
            request = ask.REQUESTS.validate_python(message["request"])
            answer = self._answers[type(request)](request, number)
        except (KeyError, ValidationError) as error:
            self._reply(number, error=RequestRefused(f"the engine does not know this request: {error}"))
        except Exception as error:
            if not isinstance(error, (ConfigError, RequestRefused)):
                log.warning("a request failed: %s: %s", type(error).__name__, error)
            self._reply(number, error=error)
        else:
            if answer is not LATER:
                if isinstance(request, ask.CHANGING):
                    # What was done is told before it is confirmed.
                    self._engine.pulse.beat()
                self._reply(number, answer=answer)

    def _reply(self, number: int, answer: object = None, error: BaseException | None = None) -> None:
        said = {"answer": answer} if error is None else {"error": to_wire(error)}
        self._engine.channel.post({"reply": number, **said})

    # ------------------------------------------------------------ to look
    def _geometry(self, request: ask.GetGeometry, number: int) -> object:
        if not self._engine.bench.dm.is_open:
            raise RequestRefused("the devices are not open")
        return geometry_of(self._engine.bench, self._engine.publisher.grid).model_dump(mode="json")

    def _procedures(self, request: ask.GetProcedures, number: int) -> object:
        return [entry.model_dump(mode="json") for entry in self._engine.offers.entries]

    def _check(self, request: ask.Check, number: int) -> object:
        engine = self._engine
        arguments = engine.offers.arguments(request.procedure, request.arguments)
        engine.offers.task(request.procedure, request.arguments, engine.shelf)
        if not engine.bench.is_open:
            raise RequestRefused("the devices are not open; nothing can be planned before they are")
        plan = engine.planner.plan(request.procedure, arguments)
        if engine.board.orders is not None:
            later = jobs.RETURNS if needs_loop(request.procedure, arguments) else "open the loop first"
            plan = plan.model_copy(update={"warnings": (*plan.warnings, f"the loop is closed: {later}")})
        return plan.model_dump(mode="json")

    # ------------------------------------------------------------ safety
    def _open_loop(self, request: ask.OpenLoop, number: int) -> object:
        engine = self._engine
        with engine.board.lock:
            runs = engine.board.running is not None
            if runs and not engine.board.needs_loop:
                return {"fault": None}  # nothing is closed, and the procedure moves the mirror
            engine.board.stop.set()
        engine.when_flat(number)
        return LATER

    def _flatten(self, request: ask.Flatten, number: int) -> object:
        with self._engine.board.lock:
            self._engine.board.stop.set()
        self._engine.when_flat(number)
        return LATER

    def _abort(self, request: ask.Abort, number: int) -> object:
        board = self._engine.board
        with board.lock:
            if board.running is None:
                return {"fault": None}
            board.stop.set()
        self._engine.when_flat(number)
        return LATER

    # ------------------------------------------------------------ to write
    def _start(self, request: ask.Start, number: int) -> object:
        engine = self._engine
        with engine.board.lock:
            arguments = engine.offers.arguments(request.procedure, request.arguments)
            loop = needs_loop(request.procedure, arguments)
            before = jobs.loop_to_return_to(engine) if loop else None
            if before is None:
                engine.board.require_idle()
            task = engine.offers.task(request.procedure, request.arguments, engine.shelf)
            config = jobs.configured(engine, task)
            task.load(config, self._engine.bench.simulated)
            run = engine.next_run
            engine.next_run += 1
            jobs.announce(engine, run, request.procedure, arguments, loop)
        engine.post(lambda: jobs.do_task(engine, task, config, before))
        return run

    def _pause(self, request: ask.Pause, number: int) -> object:
        board = self._engine.board
        if board.running is None:
            raise RequestRefused("nothing is running")
        if board.needs_loop:
            raise RequestRefused(
                f"'{board.running.name}' works in closed loop and cannot be halted; abort it"
            )
        board.paused = True
        return None

    def _resume(self, request: ask.Resume, number: int) -> object:
        if self._engine.board.running is None:
            raise RequestRefused("nothing is running")
        self._engine.board.paused = False
        return None

    def _close_loop(self, request: ask.CloseLoop, number: int) -> object:
        engine = self._engine
        with engine.board.lock:
            engine.board.require_idle()
            jobs.close_loop(engine, request, lambda error: self._reply(number, error=error))
        return LATER

    def _set_loop(self, request: ask.SetLoop, number: int) -> object:
        engine = self._engine
        with engine.board.lock:
            jobs.change_loop(engine, request)
        return None

    def _load_product(self, request: ask.LoadProduct, number: int) -> object:
        return self._engine.shelf.load(request.path, request.name).model_dump(mode="json")

    def _record(self, request: ask.Record, number: int) -> object:
        return self._engine.telemetry.turn(request.on).model_dump(mode="json")

    def _clear_fault(self, request: ask.ClearFault, number: int) -> object:
        engine = self._engine
        if engine.board.fault is None:
            return None

        def clear() -> None:
            engine.clear_fault()
            engine.pulse.beat()
            self._reply(number)

        engine.post(clear)
        return LATER

    def _shutdown(self, request: ask.Shutdown, number: int) -> object:
        self._engine.end()
        return None
