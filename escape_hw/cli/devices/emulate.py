"""``escape emulate``: emulate a device on its own interface, to test its driver without the device."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.api.emulator import Emulator

#: Period in seconds at which new protocol violations are reported.
_POLL_S = 0.2


@command("emulate")
def emulate(
    context: CommandContext,
    name: Annotated[str, typer.Argument(help="Device, such as e727; without one, lists them.")] = "",
    host: Annotated[str, typer.Option("--host", help="Network interface to listen on.")] = "127.0.0.1",
    port: Annotated[
        int | None,
        typer.Option("--port", min=0, max=65535, help="TCP port (default: the device's; 0: any free)."),
    ] = None,
    pty: Annotated[bool, typer.Option("--pty", help="Use a pseudo-terminal instead of the network.")] = False,
    option: Annotated[
        list[str] | None,
        typer.Option("--option", metavar="KEY=VALUE", help="Setting of this emulator; repeatable."),
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=0, max=86400, help="Stop after this time (default: at Ctrl-C)."),
    ] = None,
) -> None:
    """Emulate a device on its own interface until Ctrl-C; reports errors of clients (exit code 1)."""
    from escape_hw.api.emulator import EmulatorRequest
    from escape_hw.config.registry import EMULATORS, available, emulator_factory

    context.set_subject(None, True, None)
    if not name:
        context.show(*available(EMULATORS))
        context.report(emulators=list(available(EMULATORS)))
        return
    request = EmulatorRequest(host, port, pty, dict(map(_parse_option, option or ())))
    emulator = emulator_factory(name)(request)
    context.report(emulator=name, **_serve(context, name, emulator, seconds))
    if emulator.violations:
        context.code = context.code or 1


def _parse_option(text: str) -> tuple[str, str]:
    key, equals, value = text.partition("=")
    if not equals or not key:
        raise ConfigError(f"--option {text}: write KEY=VALUE")
    return key, value


def _serve(context: CommandContext, name: str, emulator: Emulator, seconds: float | None) -> dict[str, Any]:
    """Run an emulator until its time is over or Ctrl-C; returns its part of the document."""
    deadline = None if seconds is None else time.monotonic() + seconds
    n_reported = 0
    address = emulator.start()
    try:
        context.notify(f"{name}: {address}")
        while True:
            n_reported = _report_new_violations(context, name, emulator, n_reported)
            left = _POLL_S if deadline is None else deadline - time.monotonic()
            if left <= 0:
                break
            time.sleep(min(_POLL_S, left))
    except KeyboardInterrupt:
        context.notify(f"{name}: stopped")
    finally:
        emulator.stop()
    _report_new_violations(context, name, emulator, n_reported)
    violations = list(emulator.violations)
    # "complaints" is the name of version 0.1.0.
    return {"address": address, "violations": violations, "complaints": violations, **emulator.report()}


def _report_new_violations(context: CommandContext, name: str, emulator: Emulator, n_reported: int) -> int:
    """Report the violations after the first ``n_reported``; returns their present number."""
    violations = emulator.violations
    for violation in violations[n_reported:]:
        context.notify(f"{name}: protocol violation: {violation}")
    return len(violations)
