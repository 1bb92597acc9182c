"""Runs the closed loop and the procedures, with run folders, results and products."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.api.offsets import Offsets
from escape_hw.api.procedure import run as run_procedure
from escape_hw.calibration.loop.control import LoopControl
from escape_hw.calibration.loop.operation import run_until_opened
from escape_hw.config.loader import load_text
from escape_hw.config.system import SystemConfig
from escape_hw.errors import Aborted, CommandRejected, DeviceError, EscapeError, SettingRejected
from escape_hw.io.documents import to_plain_values
from escape_hw.io.fits.matrix import MatrixProduct
from escape_hw.io.run_folder import RunFolder, dated_folder
from escape_hw.remote.requests import CloseLoop, SetLoop
from escape_hw.remote.state import Arguments, Finish, FinishedRun
from escape_hw.runtime.procedures.declaration import ProcedureSpec, SavedRun
from escape_hw.runtime.procedures.matrix_input import load_fitting_matrix, require_hardware_matrix
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.server.engine.bench_owner import BenchOwner
from escape_hw.server.engine.product_store import ProductStore
from escape_hw.server.engine.state import LoopParameters, RunTicket

log = logging.getLogger(__name__)

_REMEDY = "Fix the device, then clear the fault."
#: Called once: with ``None`` when the loop is closed, or with the reason why it cannot be closed.
OnClosed = Callable[[EscapeError | None], object]


class LoopRunner:
    """Closes the loop and changes its parameters."""

    def __init__(
        self, owner: BenchOwner, product_store: ProductStore, offsets: Callable[[], Offsets] = Offsets
    ) -> None:
        self._owner, self._bench, self._state = owner, owner.bench, owner.state
        self._offsets = offsets
        self._product_store = product_store
        #: PSF without turbulence ``(rows, columns)``, once measured; the running Strehl ratio needs it.
        self.model_psf: NDArray[np.float32] | None = None

    def prepare(self, request: CloseLoop | LoopParameters) -> tuple[LoopParameters, LoopControl]:
        """Load the matrix and compute the reconstructor; nothing moves.

        ConfigError, ProductError, IncompatibleProduct or CalibrationError: a parameter is out of range, or
        the matrix does not fit this bench.
        """
        settings = self._merge(request)
        control = LoopControl(
            self._bench, self._load_matrix(settings.matrix).result,
            gain=settings.gain, leak=settings.leak, dropped_modes=settings.dropped_modes,
            offsets=self._offsets(),
        )  # fmt: skip
        return settings, control

    def close(self, request: CloseLoop, on_closed: OnClosed) -> None:
        """Close the loop until it is opened.

        RequestRefused unless the engine is idle; errors of :meth:`prepare`.
        """
        self._state.check_can_start(needs_loop=False)
        settings, control = self.prepare(request)
        self.post(settings, control, self._state.begin_loop(settings, control), on_closed)

    def post(
        self, settings: LoopParameters, control: LoopControl, stop: SignalSafeFlag, on_closed: OnClosed
    ) -> None:
        """Queue a loop that the engine's state has accepted."""
        self._owner.post(lambda: self._run(settings, control, stop, on_closed))

    def change(self, request: SetLoop) -> None:
        """Change the parameters of the loop, closed or not; those that are absent stay.

        After an error (see :meth:`prepare`) the loop continues unchanged.
        """
        before, control = self._state.snapshot.loop, self._state.snapshot.loop_control
        settings = self._merge(request)
        product = None if request.matrix is None else self._load_matrix(request.matrix)
        if control is not None:
            control.request_change(
                calibration=None if product is None else product.result,
                gain=request.gain, leak=request.leak, dropped_modes=request.dropped_modes,
            )  # fmt: skip
        self._state.set_loop_settings(settings)
        old = asdict(before)
        changes = [f"{key} {old[key]} -> {new}" for key, new in asdict(settings).items() if old[key] != new]
        log.info("loop: %s", ", ".join(changes) or "unchanged")

    def _merge(self, request: CloseLoop | SetLoop | LoopParameters) -> LoopParameters:
        requested = {key: getattr(request, key) for key in ("matrix", "gain", "leak", "dropped_modes")}
        return replace(
            self._state.snapshot.loop, **{key: value for key, value in requested.items() if value is not None}
        )

    def _load_matrix(self, name: str) -> MatrixProduct:
        # Real drivers may be connected to simulated libraries: the open devices decide what is a simulation.
        product = load_fitting_matrix(
            self._product_store.matrix_path(name), self._owner.config, self._bench.simulated
        )
        require_hardware_matrix(product, self._bench, force=False)
        return product

    def _run(
        self, settings: LoopParameters, control: LoopControl, stop: SignalSafeFlag, on_closed: OnClosed
    ) -> None:
        """Keep the loop closed until it is opened; in the main thread."""
        state = self._state
        try:
            self._bench.wfs.stop()
            self._owner.publisher.reset_residual()
            state.set_loop_closed(True)
            self._owner.state_publisher.publish()
            on_closed(None)
            log.info("loop closed on '%s', gain %g", settings.matrix, settings.gain)
            end = run_procedure(
                run_until_opened(self._bench, control, model_psf=self.model_psf),
                observers=(self._owner.observe,), abort=stop,
            )  # fmt: skip
            log.info("loop open after %d frames, %d lost; mirror flat", end.frames, end.lost_frames)
            if end.fault:
                # The parameters that led to the fault are not the default of the next loop.
                matrix = state.snapshot.loop.matrix
                state.set_loop_settings(LoopParameters.from_config(self._owner.config, matrix))
                self._owner.make_safe(f"the loop was opened: {end.fault}", _REMEDY, end.failed_device)
        except Aborted:
            log.info("loop open, mirror flat")
        except EscapeError as error:
            was_closed = state.snapshot.loop_closed
            self._owner.make_safe(str(error), _REMEDY, error.device)
            if not was_closed:
                on_closed(error)
        finally:
            state.end_loop()
            self._owner.send_flat_replies()


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
        runs: Path,
    ) -> None:
        self._owner, self._bench, self._state = owner, owner.bench, owner.state
        self._loop_runner, self._product_store, self._runs = loop_runner, product_store, runs

    def start(self, task: ProcedureSpec[Any], name: str, arguments: Arguments, needs_loop: bool) -> int:
        """Load a task, reserve the engine and queue the procedure; returns the number of its run."""
        config = load_text(self._owner.config.to_toml(), overrides=task.overrides)
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
                self._owner.make_safe(str(error), _REMEDY, error.device)
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
        saved = task.save(folder, record.with_end(stop), result, time.monotonic() - began)
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
