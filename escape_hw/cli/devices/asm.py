"""``escape asm``: states, health and faults of an adaptive secondary mirror."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.context import CommandContext, command_context
from escape_hw.cli.devices.device_tools import (
    announce_change,
    build_single_device,
    open_device,
    report_device_result,
)

if TYPE_CHECKING:
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth
    from escape_hw.config.system import SystemConfig

app = typer.Typer(
    help="Set, rest or query an adaptive secondary, and clear its faults.", no_args_is_help=True
)


@app.command("status")
def status(
    system: options.System,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Show state and health; takes no control and moves nothing."""
    with command_context("asm status", json=json) as context:
        config, mirror = _secondary(context, options.SystemSelection.of(system, set, seed, mode))
        context.devices_opened = True
        health = mirror.observe_health()
        info = mirror.info
        context.show(f"{info.model} {info.serial}", *_format_health(health))
        report_device_result(
            context, "asm status", config, info.simulated, False,
            model=info.model, serial=info.serial, **asdict(health),
        )  # fmt: skip


@app.command("set")
def set_(
    system: options.System,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Float the shell, flat: MOVES it. It stays afloat under its own control after the command."""
    with command_context("asm set", json=json) as context:
        _go_to_state(context, options.SystemSelection.of(system, set, seed, mode), "asm set", floating=True)


@app.command("rest")
def rest(
    system: options.System,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Lay the shell on its reference body: MOVES it."""
    with command_context("asm rest", json=json) as context:
        _go_to_state(context, options.SystemSelection.of(system, set, seed, mode), "asm rest", floating=False)


@app.command("clear")
def clear(
    system: options.System,
    yes: Annotated[bool, typer.Option("--yes", help="The cause is fixed; do not ask.")] = False,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Clear a latched fault after its cause is fixed; the shell is at rest afterwards."""
    with command_context("asm clear", json=json) as context:
        from escape_hw.errors import ConfigError

        config, mirror = _secondary(context, options.SystemSelection.of(system, set, seed, mode))
        context.devices_opened = True
        previous = mirror.observe_health()
        if previous.state == "fault" and not yes:
            context.notify(f"fault: {previous.fault}")
            if json or not sys.stdin.isatty() or not typer.confirm("Is its cause fixed?", err=True):
                raise ConfigError("the fault was not cleared; fix its cause, then confirm with --yes")
        if previous.state == "fault":
            announce_change(context, config, "dm", f"clear the fault '{previous.fault}'")
            with open_device(context, mirror):
                mirror.recover()
                after = mirror.health
        else:
            after = previous
        context.show(f"fault: {previous.fault or 'none'}; now {after.state}")
        changed = after is not previous
        report_device_result(
            context, "asm clear", config, mirror.info.simulated, changed,
            before=previous.state, fault=previous.fault, after=after.state,
        )  # fmt: skip


def _secondary(
    context: CommandContext, selection: options.SystemSelection
) -> tuple[SystemConfig, AdaptiveSecondary]:
    """The system's adaptive secondary, not open.

    Raises
    ------
    ConfigError
        The mirror is no adaptive secondary.
    """
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary

    config, mirror = build_single_device(context, selection, "dm", AdaptiveSecondary)  # type: ignore[type-abstract]
    # A query, or clearing a fault, must not lift the shell.
    mirror.lift = False
    return config, mirror


def _go_to_state(
    context: CommandContext, selection: options.SystemSelection, command: str, *, floating: bool
) -> None:
    """Bring the mirror to a state and leave it there."""
    from escape_hw.api.adaptive_secondary import ShellState

    config, mirror = _secondary(context, selection)
    requested = ShellState.SET if floating else ShellState.RESTED
    context.devices_opened = True
    previous = mirror.observe_health().state
    announce_change(context, config, "dm", f"from {previous} to {requested}")
    mirror.leave_set = floating
    with open_device(context, mirror):
        mirror.go_to(requested)
        health = mirror.health
    context.show(f"{previous} → {health.state}", *_format_health(health))
    report_device_result(
        context, command, config, mirror.info.simulated, previous is not health.state,
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
