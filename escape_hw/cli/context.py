"""Execution of a command: consoles, Ctrl-C, system, run folder, JSON document, exit code."""

from __future__ import annotations

import contextlib
import os
import signal
import sys
import threading
import time
import traceback
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from types import FrameType, TracebackType
from typing import TYPE_CHECKING, Any, Self, TypeGuard, TypeVar

import typer
from rich.console import Console, RenderableType

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.bounded_files import shorten_path
from escape_hw.deprecation import RenamedWarning
from escape_hw.errors import Aborted, ConfigError, EscapeError, StorageError, TooFewFrames
from escape_hw.runtime.display.console import DisplayConsole
from escape_hw.runtime.procedures.declaration import ComputedProcedure

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.cli.options import SystemSelection
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.procedures.declaration import ProcedureSpec
    from escape_hw.runtime.session.system import System


T = TypeVar("T")


#: What happens while devices are closed: a system or a mirror, and any other device.
MIRROR_CLOSING = "the mirror is being flattened and the devices closed"
DEVICE_CLOSING = "the device is being closed"
#: Signals that stop a command in an orderly way: Ctrl-C, a closed terminal, ``kill``, and Ctrl-\\.
STOP_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT)


class InterruptHandler:
    """Turns every signal of :data:`STOP_SIGNALS` into an orderly stop; does nothing outside the main thread.

    A hang-up that the process was started to ignore, as by ``nohup``, stays ignored.

    While a procedure runs, the first signal sets ``abort`` and the second raises ``KeyboardInterrupt``.
    While the devices are being closed or an aborted run is saved, signals are ignored, so that the mirror
    is flattened and the data are written. At any other time a signal raises ``KeyboardInterrupt``.
    ``notify`` is called with a line for the operator, from the signal handler.
    """

    def __init__(self, notify: Callable[[str], None]) -> None:
        self.abort = SignalSafeFlag()
        #: Name of the signal that has raised ``KeyboardInterrupt``; empty: none.
        self.interrupted_by = ""
        self._notify = notify
        self._in_procedure = False
        self._closing = self._protected_activity = ""
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Install the handlers."""
        if threading.current_thread() is threading.main_thread():
            for number in STOP_SIGNALS:
                if number == signal.SIGHUP and signal.getsignal(number) is signal.SIG_IGN:
                    continue
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Restore the previous handlers."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    @contextmanager
    def procedure(self) -> Iterator[SignalSafeFlag]:
        """Context of a running procedure; yields the flag that aborts it."""
        self._in_procedure = True
        try:
            yield self.abort
        finally:
            self._in_procedure = False

    @contextmanager
    def protect_closing(
        self, opened: AbstractContextManager[T], closing: str = MIRROR_CLOSING
    ) -> Iterator[T]:
        """Enter a device, system or server, and ignore signals while it is closed; ``closing`` says how."""
        self._closing = closing
        try:
            with opened as entered:
                try:
                    yield entered
                finally:
                    self._protected_activity = closing
        finally:
            self._closing = self._protected_activity = ""

    @contextmanager
    def protect_saving(self) -> Iterator[None]:
        """Ignore signals while the result of an aborted run is saved."""
        self._protected_activity = "the data are being saved"
        try:
            yield
        finally:
            self._protected_activity = ""

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._protected_activity:
            self._notify(f"already stopping: {self._protected_activity}")
        elif self._in_procedure and not self.abort.is_set():
            self.abort.set()
            self._notify(f"stopping: {self._closing}" if self._closing else "stopping")
        else:
            self.interrupted_by = "Ctrl-C" if number == signal.SIGINT else signal.Signals(number).name
            raise KeyboardInterrupt(self.interrupted_by)


_PIPE_WIDTH = 120
#: Exit codes; the same for every command.
DONE, FAILED, USAGE, FAULT, ABORTED = 0, 1, 2, 3, 130


class CommandContext:
    """Consoles, procedure runner, bench, run folder and JSON document of a command."""

    def __init__(self, command: str, json: bool, quiet: bool) -> None:
        self.command, self.json, self.quiet = command, json, quiet
        self._stdout = sys.stdout
        self.errors = DisplayConsole()
        # Output to a pipe or a file has no terminal width.
        self.tables = Console(file=self._stdout, width=None if self._stdout.isatty() else _PIPE_WIDTH)
        self.interrupts = InterruptHandler(self._notify_from_signal_handler)
        self.folder: RunFolder | None = None
        self._subject: dict[str, Any] = {"system": None, "simulated": None, "seed": None}
        self._device: dict[str, Any] = {}
        self.devices_opened = False
        self.code = DONE
        self._document: Mapping[str, Any] | None = None
        self._began = time.monotonic()

    @property
    def wall_seconds(self) -> float:
        """Seconds since the command started."""
        return time.monotonic() - self._began

    def notify(self, line: str) -> None:
        """Print a line for the operator on standard error, as far as it can be written."""
        with contextlib.suppress(OSError):
            self.errors.print(line, highlight=False, markup=False, soft_wrap=True)

    def _notify_from_signal_handler(self, line: str) -> None:
        """Print without the stream, which refuses a write from a handler that interrupted another write."""
        try:
            descriptor = sys.stderr.fileno()
        except (OSError, ValueError):
            self.notify(line)
            return
        with contextlib.suppress(OSError):
            # A closed standard error must not prevent the stop.
            os.write(descriptor, f"{line}\n".encode())

    def show(self, *what: RenderableType) -> None:
        """Print results on standard output, except with ``--json``."""
        for item in () if self.json else what:
            self.tables.print(item, highlight=False, markup=False, soft_wrap=isinstance(item, str))

    def result(self, document: Mapping[str, Any], met: bool = True) -> None:
        """Set the document that ``--json`` prints at the end; if ``met`` is false the exit code is 1."""
        self._document = document
        self.code = self.code or (DONE if met else FAILED)

    def report(self, met: bool = True, **content: Any) -> None:
        """Set the document of a command without a run: its header, and this content.

        The header has system, mode and seed as loaded, and driver and serial number of a command for one
        device, unless ``content`` has others.
        """
        from escape_hw.io.documents import header_fields

        self.result({**header_fields(self.command, **self._subject), **self._device, **content}, met)

    def load_config(self, selection: SystemSelection) -> SystemConfig:
        """The configuration of the selected system; error documents then have its name, mode and seed."""
        from escape_hw.config.bundled import bundled_systems
        from escape_hw.config.loader import load_system

        # The error document of a refused configuration names a bundled system.
        self.set_subject(
            selection.system if selection.system in bundled_systems() else None, None, selection.seed
        )
        config = load_system(
            selection.system, overrides=selection.set, seed=selection.seed, mode=selection.mode
        )
        self.set_subject(config.system.name, config.simulated, config.system.seed)
        return config

    def set_subject(self, system: str | None, simulated: bool | None, seed: int | None) -> None:
        """Set system, mode and seed for error documents, as far as they are known."""
        self._subject = {"system": system, "simulated": simulated, "seed": seed}

    def set_device(self, driver: str, serial: str) -> None:
        """Set the one device that the command is for; it is named in documents, also of errors."""
        self._device = {"driver": driver, "serial": serial}

    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure and show its progress; Ctrl-C aborts it.

        Raises
        ------
        Aborted
            The procedure was aborted; carries the partial result.
        """
        from escape_hw.api.procedure import run
        from escape_hw.runtime.display.progress import ProgressView

        with ProgressView(self.errors, self.quiet) as view, self.interrupts.procedure() as abort:
            return run(procedure, observers=(view,), abort=abort)

    def run_keeping_partial(self, procedure: Procedure[T]) -> tuple[T, Aborted | None]:
        """Run a procedure; after an abort, return the partial result and the exception.

        Raises
        ------
        Aborted
            There is no partial result.
        """
        try:
            return self.run(procedure), None
        except Aborted as stop:
            if stop.partial is None:
                raise
            partial: Any = stop.partial
            return partial, stop

    def protect_saving(self, stop: EscapeError | None) -> AbstractContextManager[None]:
        """Context for saving a result: after an abort or a failure, signals are ignored."""
        return contextlib.nullcontext() if stop is None else self.interrupts.protect_saving()

    def run_procedure(
        self,
        procedure: ProcedureSpec[T],
        selection: SystemSelection,
        out: Path | None,
        resumed_run: Path | None = None,
    ) -> None:
        """Run a requested procedure on the selected system, save its result and print it.

        Products go to ``out``, by default a dated folder; the folder of a continued run is not changed.

        Raises
        ------
        Aborted
            The result is partial; it was saved and printed.
        """
        from escape_hw.cli.calibration.display import format_result

        selection = selection.with_overrides(*procedure.overrides)
        config = self.load_config(selection)
        procedure.load(config)
        procedure.require_first(config)
        with self.run_folder(config, procedure.kind, out) as folder:
            if resumed_run is not None:
                self.notify(f"resuming {resumed_run}, which is not changed; products go to {folder.path}")
            if isinstance(procedure, ComputedProcedure):
                with _note_without_result():
                    result = self.run(procedure.compute())
                saved = procedure.save_computed(folder, result, self.wall_seconds)
                self.result(saved.document, met=saved.met)
                self.show(*format_result(procedure.name, result, saved.document["simulated"], saved.document))
                return
            with self.bench(selection) as bench:
                from escape_hw.runtime.session.record import BenchRecord

                record = BenchRecord.from_bench(bench)
                with _note_without_result():
                    result, stop = self.run_keeping_partial(procedure.procedure(bench, folder))
            with self.protect_saving(stop):
                saved = procedure.save(folder, record.with_end(stop), result, self.wall_seconds)
                self.result(saved.document, met=saved.met)
                self.show(*format_result(procedure.name, result, record.simulated, saved.document))
            if stop is not None:
                raise stop
            procedure.finish()

    @contextmanager
    def run_folder(self, config: SystemConfig, kind: str, out: Path | None) -> Iterator[RunFolder]:
        """The run folder with log and ``config.toml``, created before any device is opened."""
        # Libraries for saving are imported before anything moves, so that an aborted run is saved at once
        # and a failing import loses no data.
        from escape_hw.io.run_folder import RunFolder

        try:
            with RunFolder(config.system.name, kind, out) as folder:
                self.folder = folder
                if folder.requested_path is not None:
                    self.notify(
                        f"{folder.requested_path} holds files already and is left alone; "
                        f"this run goes to {folder.path}"
                    )
                folder.write_config(config.to_toml())
                yield folder
        except StorageError as error:
            if self.folder is None or str(self.folder.path) in str(error):
                error.add_note("--out chooses the folder of a run")
            raise

    def bench(self, selection: SystemSelection) -> AbstractContextManager[System]:
        """The open system; finally the mirror is flattened and the devices are closed."""
        from escape_hw.runtime.session.system import open_system

        self._require_not_served(selection)
        system = open_system(selection.system, set=selection.set, seed=selection.seed, mode=selection.mode)
        return self.open_protected(system)

    def open_protected(
        self, device: AbstractContextManager[T], closing: str = MIRROR_CLOSING
    ) -> AbstractContextManager[T]:
        """Open a device or system, and close it at the end; a Ctrl-C does not interrupt the closing.

        ``closing`` says to an operator what is done then.
        """
        self.devices_opened = True
        return self.interrupts.protect_closing(device, closing)

    def _require_not_served(self, selection: SystemSelection) -> None:
        """Refuse to open hardware that a server has opened."""
        from escape_hw.remote.address import find_server

        config = self.load_config(selection)
        if config.simulated:
            return
        name = config.system.name
        found = find_server(name)
        if found is not None and found.alive:
            raise ConfigError(
                f"'{name}' is served by process {found.pid}, which holds its devices; "
                f'work through it (escape_hw.connect("{name}"), escape gui), or stop it first'
            )

    def fail(self, error: BaseException) -> int:
        """Report an error on standard error and in the document; returns the exit code."""
        code, kind, message = self._classify_error(error)
        self.notify(f"{'aborted' if code == ABORTED else 'error'}: {message}")
        for note in getattr(error, "__notes__", ()):
            self.notify(f"  {note}")
        if self._document is None:
            self.report(**({} if self.folder is None else self.folder.location_fields()))
        self._document = {**(self._document or {}), "error": {"type": kind, "message": message}}
        return code

    def _classify_error(self, error: BaseException) -> tuple[int, str, str]:
        if isinstance(error, KeyboardInterrupt):
            return ABORTED, "Aborted", f"interrupted by {str(error) or 'Ctrl-C'}"
        if isinstance(error, StorageError | TooFewFrames) and not self.devices_opened:
            return USAGE, type(error).__name__, str(error)
        if isinstance(error, EscapeError):
            return error.exit_code, type(error).__name__, str(error)
        if signal_name := self.interrupts.interrupted_by:
            # A library that is being imported may turn the interruption into an error of its own.
            return ABORTED, "Aborted", f"interrupted by {signal_name} ({type(error).__name__})"
        if _is_file_error(error):
            message = f"{shorten_path(os.fsdecode(error.filename))}: {error.strerror or error}"
            return (FAILED if self.devices_opened else USAGE), "StorageError", message
        if isinstance(error, MemoryError):
            return FAILED, "MemoryError", f"not enough memory ({error}); ask for fewer frames or modes"
        message = f"{type(error).__name__}: {error} (this is a defect of ESCAPE)"
        if self.folder is not None and self.folder.path.is_dir():
            # The run folder has logged the traceback.
            message += f"; the traceback is in {self.folder.path / 'run.log'}"
        else:
            self.notify("".join(traceback.format_exception(error)).rstrip())
        return (FAULT if self.devices_opened else FAILED), type(error).__name__, message

    def print_document(self) -> None:
        """Print the document on standard output, once."""
        from escape_hw.io.documents import dumps

        if self.json and self._document is not None:
            document, self._document = self._document, None
            self._stdout.write(dumps(document) + "\n")
            self._stdout.flush()


@contextmanager
def _note_without_result() -> Iterator[None]:
    """Say of a run that was aborted without a partial result that it leaves none."""
    try:
        yield
    except Aborted as stop:
        stop.add_note("no result was saved")
        raise


def _is_file_error(error: BaseException) -> TypeGuard[OSError]:
    """Whether a file or folder of this computer is the cause, such as an unreadable home directory."""
    return isinstance(error, OSError) and error.filename is not None


@contextmanager
def _deprecations_as_lines(notify: Callable[[str], None]) -> Iterator[None]:
    """Report each old name that is used as one line, instead of as a Python warning."""
    reported: set[str] = set()
    show_others = warnings.showwarning

    def show(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
        if not issubclass(category, RenamedWarning):
            show_others(message, category, *where, **more)
        elif str(message) not in reported:
            reported.add(str(message))
            notify(f"deprecated: {message}")

    with warnings.catch_warnings():
        warnings.simplefilter("always", RenamedWarning)
        warnings.showwarning = show
        yield


@contextmanager
def command_context(command: str, *, json: bool = False, quiet: bool = False) -> Iterator[CommandContext]:
    """Context of a command; converts errors to exit codes and prints at most one document.

    Output of libraries to standard output is redirected to standard error.
    """
    context = CommandContext(command, json, quiet)
    with context.interrupts, _deprecations_as_lines(context.notify):
        try:
            with contextlib.redirect_stdout(sys.stderr):
                yield context
        except typer.Exit:
            raise
        except (EscapeError, KeyboardInterrupt) as error:
            context.code = context.fail(error)
        except Exception as error:
            context.code = context.fail(error)
    context.print_document()
    raise typer.Exit(context.code)
