"""``escape with_stand_ins``: everything as on the metal, with the real drivers, on the simulated bench."""

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
from escape_hw.cli.context import CommandContext, command_context

if TYPE_CHECKING:
    from escape_hw.api.emulator import StandInBench

_ESCAPE = (sys.executable, "-c", "from escape_hw.cli import main; main()")
#: What a shell says of a command that is not there.
_NOT_FOUND = 127


def with_stand_ins(
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
    with command_context("rehearse", json=json) as context:
        from escape_hw.config.registry import stand_in_bench_factory
        from escape_hw.io.documents import header_fields

        selection = options.SystemSelection.of(system, set, seed, None)
        config = context.load_config(selection)
        rehearsal = stand_in_bench_factory()(config)
        rehearsal.start()
        try:
            if command:
                context.code = _run(context, command, rehearsal.environment)
                return
            environment = dict(rehearsal.environment)
            context.show(*(f"export {key}={shlex.quote(value)}" for key, value in environment.items()))
            document = header_fields("rehearse", config.system.name, True, config.system.seed)
            context.result({**document, "environment": environment})
            # Whoever reads the document waits for it, and not for the end.
            context.print_document()
            _until_stopped(context, rehearsal)
        finally:
            rehearsal.stop()


def _run(context: CommandContext, command: Sequence[str], environment: Mapping[str, str]) -> int:
    """Run a command to its end; a Ctrl-C is its business, for its mirror must become flat."""
    # The very program that runs, also where its folder is not on the path.
    words = [*_ESCAPE, *command[1:]] if command[0] == "escape" else command
    try:
        child = subprocess.Popen(words, env={**os.environ, **environment})
    except OSError as error:
        context.notify(f"error: {command[0]}: {error.strerror}")
        return _NOT_FOUND
    while True:
        try:
            # Its end is looked at, not taken: a Ctrl-C in this very moment would lose its exit code.
            end = os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
            break
        except KeyboardInterrupt:
            context.notify("rehearse: waiting for the command to end")
    with contextlib.suppress(KeyboardInterrupt):
        child.wait()
    if end is None:
        raise RuntimeError("the command's end was not told")
    return end.si_status if end.si_code == os.CLD_EXITED else 128 + end.si_status


def _until_stopped(context: CommandContext, rehearsal: StandInBench) -> None:
    context.notify("rehearse: the bench answers as long as this runs; Ctrl-C ends it")
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        context.notify("rehearse: stopped")
