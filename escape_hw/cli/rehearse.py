"""``escape rehearse``: everything as on the metal, with the real drivers, on the simulated bench."""

from __future__ import annotations

import contextlib
import os
import shlex
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.rehearsal import Rehearsal

_ESCAPE = (sys.executable, "-c", "from escape_hw.cli import main; main()")
#: What a shell says of a command that is not there.
_NOT_FOUND = 127


def rehearse(
    system: options.System,
    command: Annotated[
        list[str] | None,
        typer.Argument(help="Command to run meanwhile, after '--'; without one: until Ctrl-C."),
    ] = None,
    set: options.Set = None,
    seed: options.Seed = None,
    json: options.Json = False,
) -> None:
    """Simulate the bench behind the real drivers, through stand-ins of their vendors' libraries.

    escape rehearse razor-shwfs -- escape calibrate razor-shwfs --mode hardware
    """
    with session("rehearse", json=json) as one:
        from escape_hw.config.registry import rehearsal_factory
        from escape_hw.io.documents import head

        choice = options.Choice.of(system, set, seed, None)
        config = one.configured(choice)
        rehearsal = rehearsal_factory()(config)
        rehearsal.start()
        try:
            if command:
                one.code = _run(one, command, rehearsal.environment)
                return
            environment = dict(rehearsal.environment)
            one.show(*(f"export {key}={shlex.quote(value)}" for key, value in environment.items()))
            document = head("rehearse", config.system.name, True, config.system.seed)
            one.result({**document, "environment": environment})
            # Whoever reads the document waits for it, and not for the end.
            one.print_document()
            _until_stopped(one, rehearsal)
        finally:
            rehearsal.stop()


def _run(one: Session, command: Sequence[str], environment: Mapping[str, str]) -> int:
    """Run a command to its end; a Ctrl-C is its business, for its mirror must become flat."""
    # The very program that runs, also where its folder is not on the path.
    words = [*_ESCAPE, *command[1:]] if command[0] == "escape" else command
    try:
        child = subprocess.Popen(words, env={**os.environ, **environment})
    except OSError as error:
        one.tell(f"error: {command[0]}: {error.strerror}")
        return _NOT_FOUND
    while True:
        try:
            # Its end is looked at, not taken: a Ctrl-C in this very moment would lose its exit code.
            end = os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
            break
        except KeyboardInterrupt:
            one.tell("rehearse: waiting for the command to end")
    with contextlib.suppress(KeyboardInterrupt):
        child.wait()
    if end is None:
        raise RuntimeError("the command's end was not told")
    return end.si_status if end.si_code == os.CLD_EXITED else 128 + end.si_status


def _until_stopped(one: Session, rehearsal: Rehearsal) -> None:
    one.tell("rehearse: the bench answers as long as this runs; Ctrl-C ends it")
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        one.tell("rehearse: stopped")
