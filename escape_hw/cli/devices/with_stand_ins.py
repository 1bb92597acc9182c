"""``escape with-stand-ins``: the real drivers on a simulated bench, with stand-ins for vendor libraries."""

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
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext

if TYPE_CHECKING:
    from escape_hw.api.emulator import StandInBench

_ESCAPE = (sys.executable, "-c", "from escape_hw.cli import main; main()")
#: A shell's exit code for a command that is not found.
_NOT_FOUND = 127


@command("with-stand-ins", without=("mode",))
def with_stand_ins(
    context: CommandContext,
    selection: options.Selection,
    command: Annotated[
        list[str] | None,
        typer.Argument(help="Command to run, after '--'; without one, runs until Ctrl-C."),
    ] = None,
) -> None:
    """Run the real drivers on a simulated bench, with stand-ins for the vendor libraries.

    escape with-stand-ins razor-shwfs -- escape calibrate razor-shwfs --mode hardware
    """
    from escape_hw.config.registry import stand_in_bench_factory

    config = context.load_config(selection)
    stand_ins = stand_in_bench_factory()(config)
    stand_ins.start()
    try:
        if command:
            context.code = _run(context, command, stand_ins.environment)
            return
        environment = dict(stand_ins.environment)
        context.show(*(f"export {key}={shlex.quote(value)}" for key, value in environment.items()))
        context.report(simulated=True, environment=environment)
        # A reader of the document must not wait for the end.
        context.print_document()
        _until_stopped(context, stand_ins)
    finally:
        stand_ins.stop()


def _run(context: CommandContext, command: Sequence[str], environment: Mapping[str, str]) -> int:
    """Run a command to its end; it handles a Ctrl-C itself, to flatten its mirror."""
    # This program, also where its folder is not on the path.
    words = [*_ESCAPE, *command[1:]] if command[0] == "escape" else command
    try:
        child = subprocess.Popen(words, env={**os.environ, **environment})
    except OSError as error:
        context.notify(f"error: {command[0]}: {error.strerror}")
        return _NOT_FOUND
    while True:
        try:
            # The exit code is not consumed: a Ctrl-C at this moment would lose it.
            end = os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
            break
        except KeyboardInterrupt:
            context.notify("with-stand-ins: waiting for the command to end")
    with contextlib.suppress(KeyboardInterrupt):
        child.wait()
    if end is None:
        raise RuntimeError("the command ended without an exit code")
    return end.si_status if end.si_code == os.CLD_EXITED else 128 + end.si_status


def _until_stopped(context: CommandContext, stand_ins: StandInBench) -> None:
    context.notify("with-stand-ins: the bench is available while this runs; stop it with Ctrl-C")
    try:
        threading.Event().wait()
    except KeyboardInterrupt:
        context.notify("with-stand-ins: stopped")
