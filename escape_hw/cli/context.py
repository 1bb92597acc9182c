"""Execution of one command: consoles, Ctrl-C, system, run folder, JSON document, exit code."""

from __future__ import annotations

import contextlib
import logging
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
from typing import TYPE_CHECKING, Any, Self, TypeVar

import typer
from rich.console import Console, RenderableType

from escape_hw.api.concurrency import SignalSafeFlag
from escape_hw.deprecation import RenamedWarning
from escape_hw.errors import Aborted, ConfigError, EscapeError, StorageError

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.cli.options import SystemSelection
    from escape_hw.config.system import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.procedures.task import Task
    from escape_hw.runtime.session.record import BenchRecord
    from escape_hw.runtime.session.system import System


class InterruptHandler:
    """Turns SIGINT and SIGTERM into an orderly stop.

    While a procedure runs, the first one sets ``abort``, the second breaks in at once. While the
    devices are being closed, or an aborted run is saved, they change nothing: the mirror gets its
    flat shape and the data their file. At any other time they break in at once. Does nothing outside
    the main thread.

    Parameters
    ----------
    tell
        Called with a line for the operator, out of a signal handler.
    """

    def __init__(self, notify: Callable[[str], None]) -> None:
        self.abort = SignalSafeFlag()
        self._notify = notify
        self._in_procedure = False
        self._protected_activity = ""
        self._previous: dict[int, Any] = {}

    def __enter__(self) -> Self:
        """Install the handlers."""
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._previous[number] = signal.signal(number, self._handle)
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Put the former handlers back."""
        for number, handler in self._previous.items():
            signal.signal(number, handler)
        self._previous.clear()

    @contextmanager
    def procedure(self) -> Iterator[SignalSafeFlag]:
        """While a procedure runs: yields the flag that aborts it."""
        self._in_procedure = True
        try:
            yield self.abort
        finally:
            self._in_procedure = False

    def begin_closing(self) -> None:
        """From here to :meth:`end_closing` nothing breaks in."""
        self._protected_activity = "the mirror is being flattened and the devices closed"

    def end_closing(self) -> None:
        """The devices are closed."""
        self._protected_activity = ""

    @contextmanager
    def protect_saving(self) -> Iterator[None]:
        """While what an aborted run measured is saved, which takes a moment, nothing breaks in."""
        self._protected_activity = "what was measured is being saved"
        try:
            yield
        finally:
            self._protected_activity = ""

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if self._protected_activity:
            self._notify(f"already stopping: {self._protected_activity}")
        elif self._in_procedure and not self.abort.is_set():
            self.abort.set()
            self._notify("stopping: the mirror is flattened and what was measured is saved")
        else:
            raise KeyboardInterrupt


T = TypeVar("T")
log = logging.getLogger(__name__)

_PIPE_WIDTH = 120
#: Exit codes; the same for every command.
DONE, FAILED, USAGE, FAULT, ABORTED = 0, 1, 2, 3, 130


class CommandContext:
    """What a command needs: consoles, the runner, a bench, a run folder, one JSON document."""

    def __init__(self, command: str, json: bool, quiet: bool) -> None:
        self.command, self.json, self.quiet = command, json, quiet
        self._stdout = sys.stdout
        self.errors = Console(stderr=True)
        # In a pipe or a log nobody's terminal limits the width.
        self.tables = Console(file=self._stdout, width=None if self._stdout.isatty() else _PIPE_WIDTH)
        self.interrupts = InterruptHandler(self._notify_from_signal_handler)
        self.folder: RunFolder | None = None
        self._subject: dict[str, Any] = {"system": None, "simulated": None, "seed": None}
        self.devices_opened = False
        self.code = DONE
        self._document: Mapping[str, Any] | None = None
        self._began = time.monotonic()

    @property
    def wall_seconds(self) -> float:
        """Seconds since the command began."""
        return time.monotonic() - self._began

    def notify(self, line: str) -> None:
        """A line for the operator, on standard error."""
        self.errors.print(line, highlight=False, markup=False, soft_wrap=True)

    def _notify_from_signal_handler(self, line: str) -> None:
        """As :meth:`notify`, out of a signal handler: a stream refuses a handler that interrupted its write."""
        try:
            descriptor = sys.stderr.fileno()
        except (OSError, ValueError):
            self.notify(line)
            return
        with contextlib.suppress(OSError):
            # When nobody reads standard error any more, stopping is what counts.
            os.write(descriptor, f"{line}\n".encode())

    def show(self, *what: RenderableType) -> None:
        """Results for people, on standard output; silent with ``--json``."""
        for item in () if self.json else what:
            self.tables.print(item, highlight=False, markup=False, soft_wrap=isinstance(item, str))

    def result(self, document: Mapping[str, Any], met: bool = True) -> None:
        """The command's document, printed at its end with ``--json``; ``met`` false: exit code 1."""
        self._document = document
        self.code = self.code or (DONE if met else FAILED)

    def load_config(self, selection: SystemSelection) -> SystemConfig:
        """The configuration of the chosen system, whose name, mode and seed an error tells, too.

        Raises
        ------
        ConfigError
            It is wrong.
        """
        from escape_hw.config.bundled import bundled_systems
        from escape_hw.config.loader import load_system

        # Even a configuration that is refused may concern a system that is known.
        self.set_subject(
            selection.system if selection.system in bundled_systems() else None, None, selection.seed
        )
        config = load_system(
            selection.system, overrides=selection.set, seed=selection.seed, mode=selection.mode
        )
        self.set_subject(config.system.name, config.simulated, config.system.seed)
        return config

    def set_subject(self, system: str | None, simulated: bool | None, seed: int | None) -> None:
        """Remember what the command is about, as far as it is known, for the document of an error."""
        self._subject = {"system": system, "simulated": simulated, "seed": seed}

    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure with progress; Ctrl-C aborts it.

        Raises
        ------
        Aborted
            With the partial result.
        """
        from escape_hw.api.procedure import run
        from escape_hw.runtime.display.progress import ProgressView

        with ProgressView(self.errors, self.quiet) as view, self.interrupts.procedure() as abort:
            return run(procedure, observers=(view,), abort=abort)

    def run_keeping_partial(self, procedure: Procedure[T]) -> tuple[T, Aborted | None]:
        """Run a procedure; an abort is returned beside what was measured, so that it can be saved.

        Raises
        ------
        Aborted
            Nothing was measured yet.
        """
        try:
            return self.run(procedure), None
        except Aborted as stop:
            if stop.partial is None:
                raise
            partial: Any = stop.partial
            return partial, stop

    def protect_saving(self, stop: Aborted | None) -> AbstractContextManager[None]:
        """While a result is saved: after an abort, no further Ctrl-C keeps it from its file."""
        return contextlib.nullcontext() if stop is None else self.interrupts.protect_saving()

    def run_task(
        self,
        task: Task[T],
        selection: SystemSelection,
        out: Path | None,
        show: Callable[[T, BenchRecord, dict[str, Any]], object],
        resumed_run: Path | None = None,
    ) -> None:
        """Do a task on the chosen system, keep its result, and show it.

        Who goes on with a run is told where the products of this one lie.

        Raises
        ------
        Aborted
            The result is partial; it was kept and shown.
        """
        selection = selection.with_overrides(*task.overrides)
        config = self.load_config(selection)
        task.load(config)
        with self.run_folder(config, task.kind, out) as folder:
            if resumed_run is not None:
                self.notify(
                    f"going on with {resumed_run}, which stays as it is; products go to {folder.path}"
                )
            with self.bench(selection) as bench:
                from escape_hw.runtime.session.record import BenchRecord

                record = BenchRecord.from_bench(bench)
                result, stop = self.run_keeping_partial(task.procedure(bench, folder))
            with self.protect_saving(stop):
                saved = task.save(folder, record, result, self.wall_seconds)
                self.result(saved.document, met=saved.met)
                show(result, record, saved.document)
            if stop is not None:
                raise stop
            task.finish()

    @contextmanager
    def run_folder(self, config: SystemConfig, kind: str, out: Path | None) -> Iterator[RunFolder]:
        """The run's folder with its log and ``config.toml``, made before anything is opened."""
        # What saves the result, too, is loaded before anything moves: who stops a run does not want
        # to wait for a library, and would lose the data if one failed to load.
        from escape_hw.io.run_folder import RunFolder

        with RunFolder(config.system.name, kind, out) as folder:
            self.folder = folder
            if folder.requested_path is not None:
                self.notify(
                    f"{folder.requested_path} holds files already and is left alone; this run goes to {folder.path}"
                )
            folder.write_config(config.to_toml())
            yield folder

    @contextmanager
    def bench(self, selection: SystemSelection) -> Iterator[System]:
        """The system, open; closed at the end whatever happens, the mirror flat."""
        from escape_hw.runtime.session.system import open_system

        self._require_not_served(selection)
        opened_system = open_system(
            selection.system, set=selection.set, seed=selection.seed, mode=selection.mode
        )
        self.devices_opened = True
        try:
            with opened_system as system:
                try:
                    yield system
                finally:
                    self.interrupts.begin_closing()
        finally:
            self.interrupts.end_closing()

    def _require_not_served(self, selection: SystemSelection) -> None:
        """Raise when a server holds the hardware that is to be opened.

        Raises
        ------
        ConfigError
            Says which, and the ways out.
        """
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
        """Tell what went wrong; returns the exit code."""
        code, kind, message = self._classify_error(error)
        self.notify(f"{'aborted' if code == ABORTED else 'error'}: {message}")
        for note in getattr(error, "__notes__", ()):
            self.notify(f"  {note}")
        document = dict(self._document or self._error_document())
        document["error"] = {"type": kind, "message": message}
        self._document = document
        return code

    def _error_document(self) -> dict[str, Any]:
        """What a document says when there is no result."""
        from escape_hw.io.documents import header_fields

        known = header_fields(self.command, **self._subject)
        return known if self.folder is None else {**known, **self.folder.location_fields()}

    def _classify_error(self, error: BaseException) -> tuple[int, str, str]:
        if isinstance(error, KeyboardInterrupt):
            return ABORTED, "Aborted", "interrupted by Ctrl-C"
        if isinstance(error, StorageError) and not self.devices_opened:
            return USAGE, type(error).__name__, str(error)
        if isinstance(error, EscapeError):
            return error.exit_code, type(error).__name__, str(error)
        message = f"{type(error).__name__}: {error} (this is a defect of ESCAPE)"
        if self.folder is not None and self.folder.path.is_dir():
            # The folder has logged the traceback on its way out.
            message += f"; the traceback is in {self.folder.path / 'run.log'}"
        else:
            self.notify("".join(traceback.format_exception(error)).rstrip())
        return (FAULT if self.devices_opened else FAILED), type(error).__name__, message

    def print_document(self) -> None:
        """Print the document on the real standard output, once; a command that serves does so early."""
        from escape_hw.io.documents import dumps

        if self.json and self._document is not None:
            document, self._document = self._document, None
            self._stdout.write(dumps(document) + "\n")
            self._stdout.flush()


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
    """A command's body; turns every ending into an exit code and at most one document.

    Whatever libraries print on standard output goes to standard error meanwhile.
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
            log.exception("unexpected")
            context.code = context.fail(error)
    context.print_document()
    raise typer.Exit(context.code)
