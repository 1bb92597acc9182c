"""``escape asm``: states, health and faults of an adaptive secondary mirror."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.cli.devices.device_tools import DeviceCommand, SelectedDevice, select_device
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth

app = typer.Typer(
    help="Set, rest or query an adaptive secondary, and clear its faults.", no_args_is_help=True
)


@app.command("status", cls=DeviceCommand)
@command("asm status")
def status(context: CommandContext, selection: options.DeviceSelection) -> None:
    """Show state and health; takes no control and moves nothing."""
    mirror = _secondary(context, selection).device
    context.devices_opened = True
    health = mirror.observe_health()
    info = mirror.info
    context.show(f"{info.model} {info.serial}", *_format_health(health))
    context.report(
        simulated=info.simulated, changed=False, model=info.model, serial=info.serial, **asdict(health)
    )


@app.command("set", cls=DeviceCommand)
@command("asm set")
def set_(context: CommandContext, selection: options.DeviceSelection) -> None:
    """Float the shell, flat: MOVES it. It stays afloat under its own control after the command."""
    _go_to_state(context, selection, floating=True)


@app.command("rest", cls=DeviceCommand)
@command("asm rest")
def rest(context: CommandContext, selection: options.DeviceSelection) -> None:
    """Lay the shell on its reference body: MOVES it."""
    _go_to_state(context, selection, floating=False)


@app.command("clear", cls=DeviceCommand)
@command("asm clear")
def clear(
    context: CommandContext,
    selection: options.DeviceSelection,
    yes: Annotated[bool, typer.Option("--yes", help="The cause is fixed; do not ask.")] = False,
) -> None:
    """Clear a latched fault after its cause is fixed; the shell is at rest afterwards."""
    chosen = _secondary(context, selection)
    mirror = chosen.device
    context.devices_opened = True
    previous = after = mirror.observe_health()
    if previous.state == "fault" and not yes:
        context.notify(f"fault: {previous.fault}")
        if context.json or not sys.stdin.isatty() or not typer.confirm("Is its cause fixed?", err=True):
            raise ConfigError("the fault was not cleared; fix its cause, then confirm with --yes")
    if previous.state == "fault":
        chosen.announce_change(context, f"clear the fault '{previous.fault}'")
        with context.open_protected(mirror):
            mirror.recover()
            after = mirror.health
    context.show(f"fault: {previous.fault or 'none'}; now {after.state}")
    context.report(
        simulated=mirror.info.simulated, serial=mirror.info.serial, changed=after is not previous,
        before=previous.state, fault=previous.fault, after=after.state,
    )  # fmt: skip


def _secondary(
    context: CommandContext, selection: options.SystemSelection
) -> SelectedDevice[AdaptiveSecondary]:
    """The adaptive secondary, not open."""
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary

    chosen = select_device(context, selection, "dm", AdaptiveSecondary)  # type: ignore[type-abstract]
    # A query, or clearing a fault, must not lift the shell.
    chosen.device.lift = False
    return chosen


def _go_to_state(context: CommandContext, selection: options.SystemSelection, *, floating: bool) -> None:
    """Bring the mirror to a state and leave it there."""
    from escape_hw.api.adaptive_secondary import ShellState

    chosen = _secondary(context, selection)
    mirror = chosen.device
    requested = ShellState.SET if floating else ShellState.RESTED
    context.devices_opened = True
    previous = mirror.observe_health().state
    chosen.announce_change(context, f"from {previous} to {requested}")
    mirror.leave_set = floating
    with context.open_protected(mirror):
        mirror.go_to(requested)
        health = mirror.health
    context.show(f"{previous} → {health.state}", *_format_health(health))
    context.report(
        simulated=mirror.info.simulated, serial=mirror.info.serial, changed=previous is not health.state,
        before=previous, after=health.state, health=asdict(health),
    )  # fmt: skip


def _format_health(health: ShellHealth) -> list[str]:
    lines = [
        f"{health.state}: gap {health.gap_m * 1e6:.1f} um, largest current {health.current_a:.3g} A, "
        f"{health.temperature_c:.1f} °C, {health.skipped} commands skipped"
    ]
    if health.contaminated:
        lines.append(f"contaminated actuators: {', '.join(map(str, health.contaminated))}")
    if health.owner:
        lines.append(f"controlled by {health.owner}")
    if health.fault:
        word = "fault" if health.state == "fault" else "note"
        lines.append(f"{word}: {health.fault}")
    return lines
