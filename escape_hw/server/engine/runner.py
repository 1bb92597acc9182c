"""Runs procedures: run folder, result, products, and the loop that was closed before."""

from __future__ import annotations

import logging
import time
from pathlib import Path
from typing import Any

from escape_hw.api.procedure import run as run_procedure
from escape_hw.config.loader import load_text
from escape_hw.config.system import SystemConfig
from escape_hw.errors import Aborted, CommandRejected, DeviceError, EscapeError, SettingRejected
from escape_hw.io.documents import to_plain_values
from escape_hw.io.run_folder import RunFolder, dated_folder
from escape_hw.remote.state import Arguments, Finish, FinishedRun
from escape_hw.runtime.procedures.declaration import ProcedureSpec, SavedRun
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.server.engine.bench_owner import BenchOwner
from escape_hw.server.engine.loop import LoopRunner
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.state import LoopParameters, RunTicket

log = logging.getLogger(__name__)

#: What happens to a closed loop when a procedure closes one of its own.
LOOP_IS_RESTORED = "it is opened for this procedure, and closed again with the same parameters afterwards"
#: Products that other requests may name.
_STORED_PRODUCTS = ("im", "escape", "docrime", "gains", "loop")


class ProcedureRunner:
    """Starts procedures and saves their results."""

    def __init__(
        self,
        owner: BenchOwner,
        loop_runner: LoopRunner,
        product_store: ProductStore,
        *,
        config_text: str,
        runs: Path,
    ) -> None:
        self._owner, self._bench, self._state = owner, owner.bench, owner.state
        self._loop_runner, self._product_store = loop_runner, product_store
        self._config_text, self._runs = config_text, runs

    def start(self, task: ProcedureSpec[Any], name: str, arguments: Arguments, needs_loop: bool) -> int:
        """Load a task, reserve the engine and queue the procedure; returns the number of its run."""
        config = load_text(self._config_text, overrides=task.overrides)
        task.load(config, self._bench.simulated)
        ticket = self._state.begin_run(name, arguments, needs_loop)
        if ticket.loop_before is not None:
            log.info("the loop is closed: %s", LOOP_IS_RESTORED)
        self._owner.post(lambda: self._run(ticket, task, config))
        return ticket.run.id

    def _run(self, ticket: RunTicket, task: ProcedureSpec[Any], config: SystemConfig) -> None:
        """Run a task to its end, save its result and report it; in the main thread."""
        run, bench = ticket.run, self._bench
        words = ", ".join(f"{key} {value}" for key, value in run.arguments.items() if value is not None)
        log.info("run %d: %s %s", run.id, run.name, words)
        previous_config, bench.config = bench.config, config
        self._owner.publisher.reset_residual()
        self._state.set_loop_closed(self._state.snapshot.needs_loop)
        try:
            finished = self._run_in_folder(ticket, task)
        finally:
            bench.config = previous_config
            self._state.set_loop_closed(False)
        level = logging.INFO if finished.finish is Finish.DONE else logging.WARNING
        message = f": {finished.message}" if finished.message else ""
        log.log(level, "run %d: %s %s%s", finished.id, finished.name, finished.finish.value, message)
        self._store_products(finished)
        self._finish(finished, ticket.loop_before)
        # The state that clients receive before the end of the run lists its products.
        self._owner.state_publisher.publish()
        self._owner.send({"ended": finished.model_dump(mode="json")})
        self._owner.send_flat_replies()

    def _run_in_folder(self, ticket: RunTicket, task: ProcedureSpec[Any]) -> FinishedRun:
        """Run in a new folder; every exception becomes the end of the run."""
        run, folder = ticket.run, None
        system = self._bench.config.system.name
        try:
            kind = f"{task.kind}-{run.id}"
            with RunFolder(system, task.kind, dated_folder(self._runs, system, kind)) as folder:
                folder.write_config(self._bench.config.to_toml())
                self._owner.send({"run": {"id": run.id, "name": run.name, "folder": str(folder.path)}})
                saved, stop = self._run_and_save(ticket, task, folder)
        except Exception as error:
            self._owner.flatten()
            finish = Finish.ABORTED if isinstance(error, Aborted) else Finish.FAILED
            if not isinstance(error, EscapeError):
                self._owner.report_defect(error)
            elif isinstance(error, DeviceError) and not isinstance(error, SettingRejected | CommandRejected):
                self._owner.make_safe(str(error), "Fix the device, then clear the fault.")
            place = "" if folder is None else str(folder.path)
            return FinishedRun(id=run.id, name=run.name, finish=finish, message=str(error), folder=place)
        message = "" if saved.met else "it did not meet its own criteria"
        if stop is not None:
            # A limit stops a run through the same flag as the operator.
            fault = self._state.snapshot.fault
            message = f"{stop if fault is None else fault.reason}; the data measured so far are saved"
        return FinishedRun(
            id=run.id, name=run.name, finish=Finish.DONE if stop is None else Finish.ABORTED,
            message=message, folder=str(folder.path),
            products={name: str(path) for name, path in saved.document["products"].items()},
            document=to_plain_values(saved.document),
        )  # fmt: skip

    def _run_and_save(
        self, ticket: RunTicket, task: ProcedureSpec[Any], folder: RunFolder
    ) -> tuple[SavedRun, Aborted | None]:
        """Run the procedure and save its result, a partial one as well."""
        if (fault := self._state.snapshot.fault) is not None:
            raise Aborted(f"the procedure was not started: {fault.reason}")
        # The camera is stopped, as when the command line starts a procedure.
        self._bench.wfs.stop()
        began, stop = time.monotonic(), None
        record = BenchRecord.from_bench(self._bench)
        try:
            result = run_procedure(
                task.procedure(self._bench, folder), observers=(self._owner.observe,), abort=ticket.stop
            )
        except Aborted as error:
            if error.partial is None:
                raise
            result, stop = error.partial, error
        # The mirror is flat: those who wait for it do not wait for the files.
        self._owner.send_flat_replies()
        self._state.set_loop_closed(False)
        grid, psf = getattr(result, "grid", None), getattr(result, "model_psf", None)
        if grid is not None:
            self._owner.publisher.set_geometry(grid)
        if psf is not None:
            self._loop_runner.model_psf = psf
            self._owner.publisher.publish_arrays({"model_psf": psf})
        saved = task.save(folder, record, result, time.monotonic() - began)
        if stop is None:
            task.finish()
        return saved, stop

    def _store_products(self, finished: FinishedRun) -> None:
        """Store the products as ``NAME-ID`` (the main one) and ``NAME-ID-KEY``."""
        main = next((key for key in ("escape", "im", "loop", finished.name) if key in finished.products), "")
        for key, path in finished.products.items():
            if key in _STORED_PRODUCTS:
                name = f"{finished.name}-{finished.id}" + ("" if key == main else f"-{key}")
                try:
                    self._product_store.add(Path(path), name)
                except EscapeError as error:
                    log.error("the product '%s' of run %d is not available: %s", key, finished.id, error)

    def _finish(self, finished: FinishedRun, loop_before: LoopParameters | None) -> None:
        """End the run; the loop is closed again as it was, unless the run was stopped or failed."""

        def log_refusal(error: EscapeError | None) -> None:
            if error is not None:
                log.error("the loop, closed before run %d, stays open: %s", finished.id, error)

        next_loop = None
        if loop_before is not None and finished.finish is Finish.DONE:
            try:
                next_loop = self._loop_runner.prepare(loop_before)
            except EscapeError as error:
                log_refusal(error)
        stop = self._state.finish_run(finished, next_loop)
        if next_loop is not None and stop is not None:
            self._loop_runner.post(*next_loop, stop, log_refusal)
        elif loop_before is not None:
            log.warning("the loop, closed before run %d, stays open", finished.id)
