"""``escape asm``: states, health and faults of an adaptive secondary mirror."""

from __future__ import annotations

import sys
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated

import typer

from escape_hw.cli import options
from escape_hw.cli.hands import announce, opened, single, told
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellHealth
    from escape_hw.config.models import SystemConfig

app = typer.Typer(help="Set, rest or ask an adaptive secondary, and clear its faults.", no_args_is_help=True)


@app.command("status")
def status(
    system: options.System,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Look at state and health; takes no control and moves nothing, whoever owns the mirror."""
    with session("asm status", json=json) as one:
        config, mirror = _secondary(one, options.Choice.of(system, set, seed, mode))
        one.was_opened = True
        health = mirror.glance()
        info = mirror.info
        one.show(f"{info.model} {info.serial}", *_lines(health))
        told(
            one, "asm status", config, info.simulated, False,
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
    """Float the shell, flat: MOVES it. It stays afloat under its own control when the command has ended."""
    with session("asm set", json=json) as one:
        _lead(one, options.Choice.of(system, set, seed, mode), "asm set", afloat=True)


@app.command("rest")
def rest(
    system: options.System,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Lay the shell on its reference body: MOVES it."""
    with session("asm rest", json=json) as one:
        _lead(one, options.Choice.of(system, set, seed, mode), "asm rest", afloat=False)


@app.command("clear")
def clear(
    system: options.System,
    yes: Annotated[bool, typer.Option("--yes", help="The cause has been seen to; do not ask.")] = False,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """End a latched fault, once an operator has seen to its cause; the shell is at rest afterwards."""
    with session("asm clear", json=json) as one:
        from escape_hw.errors import ConfigError

        config, mirror = _secondary(one, options.Choice.of(system, set, seed, mode))
        one.was_opened = True
        before = mirror.glance()
        if before.state == "fault" and not yes:
            one.tell(f"fault: {before.fault}")
            if json or not sys.stdin.isatty() or not typer.confirm("Has its cause been seen to?", err=True):
                raise ConfigError("nothing was cleared; see to the cause, then say so with --yes")
        if before.state == "fault":
            announce(one, config, "dm", f"clear the fault '{before.fault}'")
            with opened(one, mirror):
                mirror.recover()
                after = mirror.health
        else:
            after = before
        one.show(f"fault: {before.fault or 'none'}; now {after.state}")
        changed = after is not before
        told(
            one, "asm clear", config, mirror.info.simulated, changed,
            before=before.state, fault=before.fault, after=after.state,
        )  # fmt: skip


def _secondary(one: Session, choice: options.Choice) -> tuple[SystemConfig, AdaptiveSecondary]:
    """The system's adaptive secondary, not open.

    Raises
    ------
    ConfigError
        Its mirror is none.
    """
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary

    config, mirror = single(one, choice, "dm", AdaptiveSecondary)  # type: ignore[type-abstract]
    # Nothing rises because somebody asks or clears.
    mirror.lift = False
    return config, mirror


def _lead(one: Session, choice: options.Choice, command: str, *, afloat: bool) -> None:
    """Lead the mirror to a state and leave it there."""
    from escape_hw.api.adaptive_secondary import ShellState

    config, mirror = _secondary(one, choice)
    wanted = ShellState.SET if afloat else ShellState.RESTED
    one.was_opened = True
    before = mirror.glance().state
    announce(one, config, "dm", f"from {before} to {wanted}")
    mirror.leave_set = afloat
    with opened(one, mirror):
        mirror.go(wanted)
        health = mirror.health
    one.show(f"{before} → {health.state}", *_lines(health))
    told(
        one, command, config, mirror.info.simulated, before is not health.state,
        before=before, after=health.state, health=asdict(health),
    )  # fmt: skip


def _lines(health: ShellHealth) -> list[str]:
    """Health for people."""
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
