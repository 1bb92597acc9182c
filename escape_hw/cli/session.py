"""One command from start to exit code."""

from __future__ import annotations

import contextlib
import logging
import os
import sys
import time
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import typer
from rich.console import Console, RenderableType

from escape_hw.cli.interrupts import Interrupts
from escape_hw.errors import Aborted, ConfigError, EscapeError, StorageError

if TYPE_CHECKING:
    from escape_hw.api.procedure import Procedure
    from escape_hw.cli.options import Choice
    from escape_hw.config.models import SystemConfig
    from escape_hw.io.run_folder import RunFolder
    from escape_hw.runtime.records import BenchRecord
    from escape_hw.runtime.system import System
    from escape_hw.runtime.task import Task

T = TypeVar("T")
log = logging.getLogger(__name__)

_PIPE_WIDTH = 120
#: Exit codes; the same for every command.
DONE, FAILED, USAGE, FAULT, ABORTED = 0, 1, 2, 3, 130


class Session:
    """What a command needs: consoles, the runner, a bench, a run folder, one JSON document."""

    def __init__(self, command: str, json: bool, quiet: bool) -> None:
        self.command, self.json, self.quiet = command, json, quiet
        self._stdout = sys.stdout
        self.errors = Console(stderr=True)
        # In a pipe or a log nobody's terminal limits the width.
        self.tables = Console(file=self._stdout, width=None if self._stdout.isatty() else _PIPE_WIDTH)
        self.interrupts = Interrupts(self._tell_at_once)
        self.folder: RunFolder | None = None
        self._concerns: dict[str, Any] = {"system": None, "simulated": None, "seed": None}
        self.was_opened = False
        self.code = DONE
        self._document: Mapping[str, Any] | None = None
        self._began = time.monotonic()

    @property
    def wall_seconds(self) -> float:
        """Seconds since the command began."""
        return time.monotonic() - self._began

    def tell(self, line: str) -> None:
        """A line for the operator, on standard error."""
        self.errors.print(line, highlight=False, markup=False, soft_wrap=True)

    def _tell_at_once(self, line: str) -> None:
        """As :meth:`tell`, out of a signal handler: a stream refuses a handler that interrupted its write."""
        try:
            descriptor = sys.stderr.fileno()
        except (OSError, ValueError):
            self.tell(line)
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

    def configured(self, choice: Choice) -> SystemConfig:
        """The configuration of the chosen system, whose name, mode and seed an error tells, too.

        Raises
        ------
        ConfigError
            It is wrong.
        """
        from escape_hw.config.bundled import bundled_systems
        from escape_hw.config.load import load_system

        # Even a configuration that is refused may concern a system that is known.
        self.concerns(choice.system if choice.system in bundled_systems() else None, None, choice.seed)
        config = load_system(choice.system, overrides=choice.set, seed=choice.seed, mode=choice.mode)
        self.concerns(config.system.name, config.simulated, config.system.seed)
        return config

    def concerns(self, system: str | None, simulated: bool | None, seed: int | None) -> None:
        """Remember what the command is about, as far as it is known, for the document of an error."""
        self._concerns = {"system": system, "simulated": simulated, "seed": seed}

    def run(self, procedure: Procedure[T]) -> T:
        """Run a procedure with progress; Ctrl-C aborts it.

        Raises
        ------
        Aborted
            With the partial result.
        """
        from escape_hw.api.procedure import run
        from escape_hw.runtime.progress import ProgressView

        with ProgressView(self.errors, self.quiet) as view, self.interrupts.procedure() as abort:
            return run(procedure, observers=(view,), abort=abort)

    def attempt(self, procedure: Procedure[T]) -> tuple[T, Aborted | None]:
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

    def saving(self, stop: Aborted | None) -> AbstractContextManager[None]:
        """While a result is saved: after an abort, no further Ctrl-C keeps it from its file."""
        return contextlib.nullcontext() if stop is None else self.interrupts.saving()

    def perform(
        self,
        task: Task[T],
        choice: Choice,
        out: Path | None,
        show: Callable[[T, BenchRecord, dict[str, Any]], object],
        going_on: Path | None = None,
    ) -> None:
        """Do a task on the chosen system, keep its result, and show it.

        Who goes on with a run is told where the products of this one lie.

        Raises
        ------
        Aborted
            The result is partial; it was kept and shown.
        """
        choice = choice.plus(*task.overrides)
        config = self.configured(choice)
        task.load(config)
        with self.run_folder(config, task.kind, out) as folder:
            if going_on is not None:
                self.tell(f"going on with {going_on}, which stays as it is; products go to {folder.path}")
            with self.bench(choice) as bench:
                from escape_hw.runtime.records import BenchRecord

                record = BenchRecord.of(bench)
                result, stop = self.attempt(task.procedure(bench, folder))
            with self.saving(stop):
                kept = task.keep(folder, record, result, self.wall_seconds)
                self.result(kept.document, met=kept.met)
                show(result, record, kept.document)
            if stop is not None:
                raise stop
            task.done()

    @contextmanager
    def run_folder(self, config: SystemConfig, kind: str, out: Path | None) -> Iterator[RunFolder]:
        """The run's folder with its log and ``config.toml``, made before anything is opened."""
        # What saves the result, too, is loaded before anything moves: who stops a run does not want
        # to wait for a library, and would lose the data if one failed to load.
        import escape_hw.runtime.keep  # noqa: F401
        from escape_hw.io.run_folder import RunFolder

        with RunFolder(config.system.name, kind, out) as folder:
            self.folder = folder
            if folder.asked is not None:
                self.tell(
                    f"{folder.asked} holds files already and is left alone; this run goes to {folder.path}"
                )
            folder.write_config(config.to_toml())
            yield folder

    @contextmanager
    def bench(self, choice: Choice) -> Iterator[System]:
        """The system, open; closed at the end whatever happens, the mirror flat."""
        from escape_hw.runtime.system import open_system

        self._refuse_served(choice)
        opened = open_system(choice.system, set=choice.set, seed=choice.seed, mode=choice.mode)
        self.was_opened = True
        try:
            with opened as system:
                try:
                    yield system
                finally:
                    self.interrupts.begin_closing()
        finally:
            self.interrupts.end_closing()

    def _refuse_served(self, choice: Choice) -> None:
        """Raise when a server holds the hardware that is to be opened.

        Raises
        ------
        ConfigError
            Says which, and the ways out.
        """
        from escape_hw.remote.address import find_listing

        config = self.configured(choice)
        if config.simulated:
            return
        name = config.system.name
        found = find_listing(name)
        if found is not None and found.alive:
            raise ConfigError(
                f"'{name}' is served by process {found.pid}, which holds its devices; "
                f'work through it (escape_hw.connect("{name}"), escape gui), or stop it first'
            )

    def fail(self, error: BaseException) -> int:
        """Tell what went wrong; returns the exit code."""
        code, kind, message = self._verdict(error)
        self.tell(f"{'aborted' if code == ABORTED else 'error'}: {message}")
        for note in getattr(error, "__notes__", ()):
            self.tell(f"  {note}")
        document = dict(self._document or self._bare_document())
        document["error"] = {"type": kind, "message": message}
        self._document = document
        return code

    def _bare_document(self) -> dict[str, Any]:
        """What a document says when there is no result."""
        from escape_hw.io.documents import head

        known = head(self.command, **self._concerns)
        return known if self.folder is None else {**known, **self.folder.place()}

    def _verdict(self, error: BaseException) -> tuple[int, str, str]:
        if isinstance(error, KeyboardInterrupt):
            return ABORTED, "Aborted", "interrupted by Ctrl-C"
        if isinstance(error, StorageError) and not self.was_opened:
            return USAGE, type(error).__name__, str(error)
        if isinstance(error, EscapeError):
            return error.exit_code, type(error).__name__, str(error)
        message = f"{type(error).__name__}: {error} (this is a defect of ESCAPE)"
        if self.folder is not None and self.folder.path.is_dir():
            # The folder has logged the traceback on its way out.
            message += f"; the traceback is in {self.folder.path / 'run.log'}"
        else:
            self.tell("".join(traceback.format_exception(error)).rstrip())
        return (FAULT if self.was_opened else FAILED), type(error).__name__, message

    def print_document(self) -> None:
        """Print the document on the real standard output, once; a command that serves does so early."""
        from escape_hw.io.documents import dumps

        if self.json and self._document is not None:
            document, self._document = self._document, None
            self._stdout.write(dumps(document) + "\n")
            self._stdout.flush()


@contextmanager
def session(command: str, *, json: bool = False, quiet: bool = False) -> Iterator[Session]:
    """A command's body; turns every ending into an exit code and at most one document.

    Whatever libraries print on standard output goes to standard error meanwhile.
    """
    one = Session(command, json, quiet)
    with one.interrupts:
        try:
            with contextlib.redirect_stdout(sys.stderr):
                yield one
        except typer.Exit:
            raise
        except (EscapeError, KeyboardInterrupt) as error:
            one.code = one.fail(error)
        except Exception as error:
            log.exception("unexpected")
            one.code = one.fail(error)
    one.print_document()
    raise typer.Exit(one.code)
