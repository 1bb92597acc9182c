"""What the engine's main thread does: procedures with their folders, the loop, making safe."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import asdict, replace
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from escape_hw.api.flag import Flag
from escape_hw.api.procedure import run as run_procedure
from escape_hw.calibration.endless_loop import keep_closed
from escape_hw.calibration.loop_orders import LoopOrders
from escape_hw.config.load import load_text
from escape_hw.config.models import SystemConfig
from escape_hw.errors import Aborted, CommandRejected, DeviceError, EscapeError, SettingRejected
from escape_hw.io.documents import plain
from escape_hw.io.fits import MatrixProduct
from escape_hw.io.provenance import utc_text
from escape_hw.io.run_folder import RunFolder
from escape_hw.remote.requests import CloseLoop, SetLoop
from escape_hw.remote.state import Ended, Finish, Phase, Running
from escape_hw.runtime.records import BenchRecord
from escape_hw.runtime.task import Kept, Task, fitting_matrix, refuse_simulated
from escape_hw.server.board import LoopChoice

if TYPE_CHECKING:
    from escape_hw.server.engine import Engine

log = logging.getLogger(__name__)

#: What becomes of a closed loop when a procedure closes one of its own.
RETURNS = "it is opened for this, and closed again as it was when this has come to its end"
#: Products that the shelf takes.
_SHELVED = ("im", "escape", "docrime", "gains", "loop")


def configured(engine: Engine, task: Task[Any]) -> SystemConfig:
    """The configuration that a task runs with."""
    return load_text(engine.setup.config_text, overrides=task.overrides)


def loop_to_return_to(engine: Engine) -> LoopChoice | None:
    """The closed loop, for whoever closes one of his own meanwhile; ``None``: it is open, or being opened."""
    board = engine.board
    if board.orders is None or board.stop.is_set() or board.fault is not None or board.running is not None:
        return None
    return board.loop


def announce(engine: Engine, run: int, name: str, arguments: dict[str, Any], loop: bool) -> None:
    """Say that a procedure begins, and whether it closes the loop; nothing else is started from here on."""
    board = engine.board
    if board.orders is not None:
        log.info("the loop is closed: %s", RETURNS)
        board.orders.open()
    board.stop, board.paused, board.needs_loop = Flag(), False, loop
    board.running = Running(id=run, name=name, arguments=arguments, stage="starting", started_utc=utc_text())
    board.phase = Phase.PROCEDURE


def do_task(engine: Engine, task: Task[Any], config: SystemConfig, before: LoopChoice | None = None) -> None:
    """Do a task to its end, keep its result, and say how it ended; then the loop is as ``before``."""
    board, bench = engine.board, engine.bench
    running = board.running
    if running is None:
        raise RuntimeError("a task begins that was not announced")
    log.info("run %d: %s %s", running.id, running.name, _words(running.arguments))
    usual, bench.config = bench.config, config
    engine.publisher.forget_residual()
    board.closed = board.needs_loop
    try:
        ended = _run(engine, task, running)
    finally:
        bench.config = usual
        board.closed = board.needs_loop = False
    level = logging.INFO if ended.finish is Finish.DONE else logging.WARNING
    why = f": {ended.message}" if ended.message else ""
    log.log(level, "run %d: %s %s%s", ended.id, ended.name, ended.finish.value, why)
    _shelve(engine, ended)
    with board.lock:
        board.last, board.running = ended, None
        board.phase = Phase.IDLE if board.fault is None else Phase.FAULT
        _return_to(engine, ended, before)
    # Whoever hears of the end finds its products in the state already.
    engine.pulse.beat()
    engine.channel.post({"ended": ended.model_dump(mode="json")})
    engine.answer_flat()


def _run(engine: Engine, task: Task[Any], running: Running) -> Ended:
    """Run in a folder; whatever happens becomes an end with its reason."""
    folder: RunFolder | None = None
    try:
        with RunFolder(engine.config.system.name, task.kind, _place(engine, task, running.id)) as folder:
            folder.write_config(engine.bench.config.to_toml())
            engine.channel.post({"run": {"id": running.id, "name": running.name, "folder": str(folder.path)}})
            kept, stop = _measured(engine, task, folder)
    except Exception as error:
        engine.flatten()
        finish = Finish.ABORTED if isinstance(error, Aborted) else Finish.FAILED
        if not isinstance(error, EscapeError):
            log.exception("unexpected")
            engine.make_safe(f"{type(error).__name__}: {error} (this is a defect of ESCAPE)", "see the log")
        elif isinstance(error, DeviceError) and not isinstance(error, SettingRejected | CommandRejected):
            engine.make_safe(str(error), "mend it, then clear the fault")
        place = "" if folder is None else str(folder.path)
        return Ended(id=running.id, name=running.name, finish=finish, message=str(error), folder=place)
    products = {name: str(path) for name, path in kept.document["products"].items()}
    message = "" if kept.met else "it did not meet its own criteria"
    if stop is not None:
        # A watchdog stops a run as the operator does, by the same flag.
        fault = engine.board.fault
        message = f"{stop if fault is None else fault.reason}; what was measured is kept"
    return Ended(
        id=running.id, name=running.name, finish=Finish.DONE if stop is None else Finish.ABORTED,
        message=message,
        folder=str(folder.path), products=products, document=plain(kept.document),
    )  # fmt: skip


def _measured(engine: Engine, task: Task[Any], folder: RunFolder) -> tuple[Kept, Aborted | None]:
    """Run the procedure and keep what it measured, a partial result as well."""
    if engine.board.fault is not None:
        raise Aborted(f"nothing was begun: {engine.board.fault.reason}")
    # A procedure finds the camera as the command line hands it over.
    engine.bench.wfs.stop()
    began, stop = time.monotonic(), None
    record = BenchRecord.of(engine.bench)
    try:
        result = run_procedure(
            task.procedure(engine.bench, folder), observers=(engine.observe,), abort=engine.board.stop
        )
    except Aborted as error:
        if error.partial is None:
            raise
        result, stop = error.partial, error
    # Whoever asked for a flat mirror does not wait for files.
    engine.answer_flat()
    engine.board.closed = False
    _learn(engine, result)
    kept = task.keep(folder, record, result, time.monotonic() - began)
    if stop is None:
        task.done()
    return kept, stop


def _learn(engine: Engine, result: object) -> None:
    """Keep what a result tells of the bench: where the slopes are, what an image should look like."""
    grid, psf = getattr(result, "grid", None), getattr(result, "model_psf", None)
    if grid is not None:
        engine.publisher.show(grid)
    if psf is not None:
        engine.model_psf = psf
        engine.publisher.arrays({"model_psf": psf})


def _place(engine: Engine, task: Task[Any], run: int) -> Path:
    now = datetime.now().astimezone()
    return (
        engine.setup.runs / f"{now:%Y-%m-%d}" / f"{now:%H%M%S}_{engine.config.system.name}_{task.kind}-{run}"
    )


def _shelve(engine: Engine, ended: Ended) -> None:
    # One product has the run's own name: a matrix that was computed before the one it was computed from.
    main = next((key for key in ("escape", "im", "loop", ended.name) if key in ended.products), "")
    for key, path in ended.products.items():
        if key in _SHELVED:
            name = f"{ended.name}-{ended.id}" + ("" if key == main else f"-{key}")
            try:
                engine.shelf.put(Path(path), name)
            except EscapeError as error:
                log.error("%s of run %d is not offered: %s", key, ended.id, error)


def _words(arguments: dict[str, Any]) -> str:
    return ", ".join(f"{key} {value}" for key, value in arguments.items() if value is not None)


# ---------------------------------------------------------------- the loop
def _return_to(engine: Engine, ended: Ended, before: LoopChoice | None) -> None:
    """Close the loop again as it was, unless somebody stopped what ran or something went wrong."""
    if before is None:
        return
    if ended.finish is not Finish.DONE or engine.board.fault is not None or engine.board.stop.is_set():
        log.warning("the loop, closed before run %d, stays open", ended.id)
        return
    try:
        close_loop(engine, before, lambda error: _say_open(ended, error))
    except EscapeError as error:
        _say_open(ended, error)


def _say_open(ended: Ended, error: EscapeError | None) -> None:
    if error is not None:
        log.error("the loop, closed before run %d, stays open: %s", ended.id, error)


def fitting(engine: Engine, name: str) -> MatrixProduct:
    """A matrix off the shelf that fits this bench.

    Raises
    ------
    ConfigError, ProductError, IncompatibleProduct
        There is none of that name, or it belongs elsewhere.
    """
    # Real drivers may stand on stand-ins: what is open says whether this is a simulation.
    product = fitting_matrix(engine.shelf.matrix(name), engine.config, engine.bench.simulated)
    refuse_simulated(product, engine.bench, force=False)
    return product


def close_loop(
    engine: Engine, request: CloseLoop | LoopChoice, told: Callable[[EscapeError | None], object]
) -> None:
    """Close the loop and keep it closed until it is told to open.

    ``told`` is called when it is closed, with ``None``, or with the reason for which it cannot be.

    Raises
    ------
    ConfigError, ProductError, IncompatibleProduct, CalibrationError
        The parameters mean nothing, or the matrix belongs elsewhere; nothing moves.
    """
    board = engine.board
    wanted = _wanted(engine, request)
    product = fitting(engine, wanted.matrix)
    orders = LoopOrders(
        engine.bench, product.result,
        gain=wanted.gain, leak=wanted.leak, dropped_modes=wanted.dropped_modes,
    )  # fmt: skip
    board.loop, board.orders = wanted, orders
    board.phase, board.stop, board.needs_loop = Phase.LOOP, Flag(), True
    engine.post(lambda: _keep_loop_closed(engine, orders, told))


def change_loop(engine: Engine, request: SetLoop) -> None:
    """Change the loop's parameters; what is absent stays. A closed loop takes them up at once.

    Raises
    ------
    ConfigError, ProductError, IncompatibleProduct, CalibrationError
        As for :func:`close_loop`; the loop goes on as it was.
    """
    board = engine.board
    wanted = _wanted(engine, request)
    product = None if request.matrix is None else fitting(engine, request.matrix)
    if board.orders is not None:
        board.orders.change(
            closing=None if product is None else product.result,
            gain=request.gain, leak=request.leak, dropped_modes=request.dropped_modes,
        )  # fmt: skip
    said = [
        f"{key} {old} -> {new}"
        for key, old, new in zip(
            asdict(wanted), asdict(board.loop).values(), asdict(wanted).values(), strict=True
        )
        if old != new
    ]
    board.loop = wanted
    log.info("loop: %s", ", ".join(said) or "as it was")


def _wanted(engine: Engine, request: CloseLoop | SetLoop | LoopChoice) -> LoopChoice:
    asked = {key: getattr(request, key) for key in ("matrix", "gain", "leak", "dropped_modes")}
    return replace(engine.board.loop, **{key: value for key, value in asked.items() if value is not None})


def _keep_loop_closed(
    engine: Engine, orders: LoopOrders, told: Callable[[EscapeError | None], object]
) -> None:
    board, bench = engine.board, engine.bench
    try:
        bench.wfs.stop()
        engine.publisher.forget_residual()
        board.closed = True
        engine.pulse.beat()
        told(None)
        log.info("loop closed on '%s', gain %g", board.loop.matrix, board.loop.gain)
        end = run_procedure(
            keep_closed(bench, orders, model_psf=engine.model_psf),
            observers=(engine.observe,), abort=board.stop,
        )  # fmt: skip
        log.info("loop open after %d frames, %d lost; mirror flat", end.frames, end.lost_frames)
        if end.fault:
            # What led there is not what the next loop begins with.
            board.loop = LoopChoice.configured(engine.config, board.loop.matrix)
            engine.make_safe(f"the loop was opened: {end.fault}", "mend it, then clear the fault")
    except Aborted:
        log.info("loop open, mirror flat")
    except EscapeError as error:
        was_closed = board.closed
        engine.make_safe(str(error), "mend it, then clear the fault")
        if not was_closed:
            told(error)
    finally:
        board.closed = False
        # A procedure that waits for this end has said already whether it needs one.
        board.needs_loop = board.needs_loop and board.running is not None
        board.orders, board.loop_metrics = None, {}
        if board.phase is Phase.LOOP:
            board.phase = Phase.IDLE
        engine.answer_flat()


# ---------------------------------------------------------------- safety
def make_safe_now(
    engine: Engine, reason: str, way_out: str = "look at the log, then clear the fault"
) -> None:
    """Stop what runs, and latch the reason; from any thread."""
    log.error("FAULT: %s", reason)
    engine.board.latch(reason, way_out)
    engine.board.stop.set()
    engine.post(lambda: engine.make_safe(reason, way_out))
