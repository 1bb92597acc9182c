"""What the engine's main thread does: procedures with their folders, the loop, making safe."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.api.procedure import run as run_procedure
from escape_hw.calibration.loop.control import LoopControl
from escape_hw.calibration.loop.operation import run_until_opened
from escape_hw.config.loader import load_text
from escape_hw.config.system import SystemConfig
from escape_hw.errors import Aborted, CommandRejected, DeviceError, EscapeError, SettingRejected
from escape_hw.io.documents import to_plain_values
from escape_hw.io.fits.matrix import MatrixProduct
from escape_hw.io.provenance import format_utc
from escape_hw.io.run_folder import RunFolder
from escape_hw.remote.requests import CloseLoop, SetLoop
from escape_hw.remote.state import ActiveRun, Finish, FinishedRun, Phase
from escape_hw.runtime.procedures.task import SavedRun, Task, load_fitting_matrix, require_hardware_matrix
from escape_hw.runtime.session.record import BenchRecord
from escape_hw.server.engine.state import LoopSettings

if TYPE_CHECKING:
    from escape_hw.server.engine.main import Engine

log = logging.getLogger(__name__)

#: What becomes of a closed loop when a procedure closes one of its own.
LOOP_IS_RESTORED = "it is opened for this, and closed again as it was when this has come to its end"
#: Products that the shelf takes.
_STORED_PRODUCTS = ("im", "escape", "docrime", "gains", "loop")


def config_of_task(engine: Engine, task: Task[Any]) -> SystemConfig:
    """The configuration that a task runs with."""
    return load_text(engine.setup.config_text, overrides=task.overrides)


def loop_to_restore(engine: Engine) -> LoopSettings | None:
    """The closed loop, for whoever closes one of his own meanwhile; ``None``: it is open, or being opened."""
    engine_state = engine.engine_state
    if (
        engine_state.loop_control is None
        or engine_state.stop.is_set()
        or engine_state.fault is not None
        or engine_state.running is not None
    ):
        return None
    return engine_state.loop


def begin_run(engine: Engine, run: int, name: str, arguments: dict[str, Any], loop: bool) -> None:
    """Say that a procedure begins, and whether it closes the loop; nothing else is started from here on."""
    engine_state = engine.engine_state
    if engine_state.loop_control is not None:
        log.info("the loop is closed: %s", LOOP_IS_RESTORED)
        engine_state.loop_control.request_open()
    engine_state.stop, engine_state.paused, engine_state.needs_loop = SignalSafeFlag(), False, loop
    engine_state.running = ActiveRun(
        id=run, name=name, arguments=arguments, stage="starting", started_utc=format_utc()
    )
    engine_state.phase = Phase.PROCEDURE


def run_task(
    engine: Engine, task: Task[Any], config: SystemConfig, loop_before: LoopSettings | None = None
) -> None:
    """Do a task to its end, keep its result, and say how it ended; then the loop is as ``loop_before``."""
    engine_state, bench = engine.engine_state, engine.bench
    running = engine_state.running
    if running is None:
        raise RuntimeError("a task begins that was not announced")
    log.info("run %d: %s %s", running.id, running.name, _format_arguments(running.arguments))
    previous_config, bench.config = bench.config, config
    engine.publisher.reset_residual()
    engine_state.closed = engine_state.needs_loop
    try:
        ended = _run(engine, task, running)
    finally:
        bench.config = previous_config
        engine_state.closed = engine_state.needs_loop = False
    level = logging.INFO if ended.finish is Finish.DONE else logging.WARNING
    why = f": {ended.message}" if ended.message else ""
    log.log(level, "run %d: %s %s%s", ended.id, ended.name, ended.finish.value, why)
    _store_products(engine, ended)
    with engine_state.lock:
        engine_state.last, engine_state.running = ended, None
        engine_state.phase = Phase.IDLE if engine_state.fault is None else Phase.FAULT
        _restore_loop(engine, ended, loop_before)
    # Whoever hears of the end finds its products in the state already.
    engine.state_publisher.publish()
    engine.channel.post({"ended": ended.model_dump(mode="json")})
    engine.send_flat_replies()


def _run(engine: Engine, task: Task[Any], running: ActiveRun) -> FinishedRun:
    """Run in a folder; whatever happens becomes an end with its reason."""
    folder: RunFolder | None = None
    try:
        with RunFolder(
            engine.config.system.name, task.kind, _run_folder_path(engine, task, running.id)
        ) as folder:
            folder.write_config(engine.bench.config.to_toml())
            engine.channel.post({"run": {"id": running.id, "name": running.name, "folder": str(folder.path)}})
            saved, stop = _run_and_save(engine, task, folder)
    except Exception as error:
        engine.flatten()
        finish = Finish.ABORTED if isinstance(error, Aborted) else Finish.FAILED
        if not isinstance(error, EscapeError):
            log.exception("unexpected")
            engine.make_safe(f"{type(error).__name__}: {error} (this is a defect of ESCAPE)", "see the log")
        elif isinstance(error, DeviceError) and not isinstance(error, SettingRejected | CommandRejected):
            engine.make_safe(str(error), "mend it, then clear the fault")
        place = "" if folder is None else str(folder.path)
        return FinishedRun(id=running.id, name=running.name, finish=finish, message=str(error), folder=place)
    products = {name: str(path) for name, path in saved.document["products"].items()}
    message = "" if saved.met else "it did not meet its own criteria"
    if stop is not None:
        # A watchdog stops a run as the operator does, by the same flag.
        fault = engine.engine_state.fault
        message = f"{stop if fault is None else fault.reason}; what was measured is kept"
    return FinishedRun(
        id=running.id, name=running.name, finish=Finish.DONE if stop is None else Finish.ABORTED,
        message=message,
        folder=str(folder.path), products=products, document=to_plain_values(saved.document),
    )  # fmt: skip


def _run_and_save(engine: Engine, task: Task[Any], folder: RunFolder) -> tuple[SavedRun, Aborted | None]:
    """Run the procedure and keep what it measured, a partial result as well."""
    if engine.engine_state.fault is not None:
        raise Aborted(f"nothing was begun: {engine.engine_state.fault.reason}")
    # A procedure finds the camera as the command line hands it over.
    engine.bench.wfs.stop()
    began, stop = time.monotonic(), None
    record = BenchRecord.from_bench(engine.bench)
    try:
        result = run_procedure(
            task.procedure(engine.bench, folder), observers=(engine.observe,), abort=engine.engine_state.stop
        )
    except Aborted as error:
        if error.partial is None:
            raise
        result, stop = error.partial, error
    # Whoever asked for a flat mirror does not wait for files.
    engine.send_flat_replies()
    engine.engine_state.closed = False
    _update_from_result(engine, result)
    saved = task.save(folder, record, result, time.monotonic() - began)
    if stop is None:
        task.finish()
    return saved, stop


def _update_from_result(engine: Engine, result: object) -> None:
    """Keep what a result tells of the bench: where the slopes are, what an image should look like."""
    grid, psf = getattr(result, "grid", None), getattr(result, "model_psf", None)
    if grid is not None:
        engine.publisher.set_geometry(grid)
    if psf is not None:
        engine.model_psf = psf
        engine.publisher.arrays({"model_psf": psf})


def _run_folder_path(engine: Engine, task: Task[Any], run: int) -> Path:
    now = datetime.now().astimezone()
    return (
        engine.setup.runs / f"{now:%Y-%m-%d}" / f"{now:%H%M%S}_{engine.config.system.name}_{task.kind}-{run}"
    )


def _store_products(engine: Engine, ended: FinishedRun) -> None:
    # One product has the run's own name: a matrix that was computed before the one it was computed from.
    main = next((key for key in ("escape", "im", "loop", ended.name) if key in ended.products), "")
    for key, path in ended.products.items():
        if key in _STORED_PRODUCTS:
            name = f"{ended.name}-{ended.id}" + ("" if key == main else f"-{key}")
            try:
                engine.product_store.put(Path(path), name)
            except EscapeError as error:
                log.error("%s of run %d is not offered: %s", key, ended.id, error)


def _format_arguments(arguments: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in arguments.items() if value is not None)


# ---------------------------------------------------------------- the loop
def _restore_loop(engine: Engine, ended: FinishedRun, loop_before: LoopSettings | None) -> None:
    """Close the loop again as it was, unless somebody stopped what ran or something went wrong."""
    if loop_before is None:
        return
    if (
        ended.finish is not Finish.DONE
        or engine.engine_state.fault is not None
        or engine.engine_state.stop.is_set()
    ):
        log.warning("the loop, closed before run %d, stays open", ended.id)
        return
    try:
        close_loop(engine, loop_before, lambda error: _log_loop_stays_open(ended, error))
    except EscapeError as error:
        _log_loop_stays_open(ended, error)


def _log_loop_stays_open(ended: FinishedRun, error: EscapeError | None) -> None:
    if error is not None:
        log.error("the loop, closed before run %d, stays open: %s", ended.id, error)


def stored_matrix(engine: Engine, name: str) -> MatrixProduct:
    """A matrix off the shelf that fits this bench.

    Raises
    ------
    ConfigError, ProductError, IncompatibleProduct
        There is none of that name, or it belongs elsewhere.
    """
    # Real drivers may stand on stand-ins: what is open says whether this is a simulation.
    product = load_fitting_matrix(engine.product_store.matrix(name), engine.config, engine.bench.simulated)
    require_hardware_matrix(product, engine.bench, force=False)
    return product


def close_loop(
    engine: Engine, request: CloseLoop | LoopSettings, on_closed: Callable[[EscapeError | None], object]
) -> None:
    """Close the loop and keep it closed until it is told to open.

    ``on_closed`` is called when it is closed, with ``None``, or with the reason for which it cannot be.

    Raises
    ------
    ConfigError, ProductError, IncompatibleProduct, CalibrationError
        The parameters mean nothing, or the matrix belongs elsewhere; nothing moves.
    """
    engine_state = engine.engine_state
    requested = _requested_settings(engine, request)
    product = stored_matrix(engine, requested.matrix)
    loop_control = LoopControl(
        engine.bench, product.result,
        gain=requested.gain, leak=requested.leak, dropped_modes=requested.dropped_modes,
    )  # fmt: skip
    engine_state.loop, engine_state.loop_control = requested, loop_control
    engine_state.phase, engine_state.stop, engine_state.needs_loop = Phase.LOOP, SignalSafeFlag(), True
    engine.post(lambda: _run_loop_until_opened(engine, loop_control, on_closed))


def change_loop_settings(engine: Engine, request: SetLoop) -> None:
    """Change the loop's parameters; what is absent stays. A closed loop takes them up at once.

    Raises
    ------
    ConfigError, ProductError, IncompatibleProduct, CalibrationError
        As for :func:`close_loop`; the loop goes on as it was.
    """
    engine_state = engine.engine_state
    requested = _requested_settings(engine, request)
    product = None if request.matrix is None else stored_matrix(engine, request.matrix)
    if engine_state.loop_control is not None:
        engine_state.loop_control.request_change(
            calibration=None if product is None else product.result,
            gain=request.gain, leak=request.leak, dropped_modes=request.dropped_modes,
        )  # fmt: skip
    said = [
        f"{key} {old} -> {new}"
        for key, old, new in zip(
            asdict(requested), asdict(engine_state.loop).values(), asdict(requested).values(), strict=True
        )
        if old != new
    ]
    engine_state.loop = requested
    log.info("loop: %s", ", ".join(said) or "as it was")


def _requested_settings(engine: Engine, request: CloseLoop | SetLoop | LoopSettings) -> LoopSettings:
    asked = {key: getattr(request, key) for key in ("matrix", "gain", "leak", "dropped_modes")}
    return replace(
        engine.engine_state.loop, **{key: value for key, value in asked.items() if value is not None}
    )


def _run_loop_until_opened(
    engine: Engine, loop_control: LoopControl, on_closed: Callable[[EscapeError | None], object]
) -> None:
    engine_state, bench = engine.engine_state, engine.bench
    try:
        bench.wfs.stop()
        engine.publisher.reset_residual()
        engine_state.closed = True
        engine.state_publisher.publish()
        on_closed(None)
        log.info("loop closed on '%s', gain %g", engine_state.loop.matrix, engine_state.loop.gain)
        end = run_procedure(
            run_until_opened(bench, loop_control, model_psf=engine.model_psf),
            observers=(engine.observe,), abort=engine_state.stop,
        )  # fmt: skip
        log.info("loop open after %d frames, %d lost; mirror flat", end.frames, end.lost_frames)
        if end.fault:
            # What led there is not what the next loop begins with.
            engine_state.loop = LoopSettings.from_config(engine.config, engine_state.loop.matrix)
            engine.make_safe(f"the loop was opened: {end.fault}", "mend it, then clear the fault")
    except Aborted:
        log.info("loop open, mirror flat")
    except EscapeError as error:
        had_closed = engine_state.closed
        engine.make_safe(str(error), "mend it, then clear the fault")
        if not had_closed:
            on_closed(error)
    finally:
        engine_state.closed = False
        # A procedure that waits for this end has said already whether it needs one.
        engine_state.needs_loop = engine_state.needs_loop and engine_state.running is not None
        engine_state.loop_control, engine_state.loop_statistics = None, {}
        if engine_state.phase is Phase.LOOP:
            engine_state.phase = Phase.IDLE
        engine.send_flat_replies()


# ---------------------------------------------------------------- safety
def make_safe_now(
    engine: Engine, reason: str, way_out: str = "look at the log, then clear the fault"
) -> None:
    """Stop what runs, and latch the reason; from any thread."""
    log.error("FAULT: %s", reason)
    engine.engine_state.latch_fault(reason, way_out)
    engine.engine_state.stop.set()
    engine.post(lambda: engine.make_safe(reason, way_out))
