"""``escape dm``: flatten, poke and query the deformable mirror."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.cli.devices.device_tools import DeviceCommand, SelectedDevice, check_number, select_device
from escape_hw.errors import CommandRejected, ConfigError

if TYPE_CHECKING:
    from escape_hw.api.mirror import DeformableMirror

app = typer.Typer(
    help="Flatten, poke or query the deformable mirror; simulated or real.", no_args_is_help=True
)
Seconds = Annotated[float, typer.Option("--seconds", min=0, max=3600, help="Duration; flat afterwards.")]
#: Part of a wave's commands that may be missed, as by a busy computer.
_TOLERATED_MISSES = 0.1


@app.command("flat", cls=DeviceCommand)
@command("dm flat")
def flat(context: CommandContext, selection: options.DeviceSelection) -> None:
    """Ramp to the flat shape: MOVES the mirror."""
    chosen = _mirror(context, selection)
    dm = chosen.device
    chosen.announce_change(context, "ramp to flat")
    _preserve_floating(dm)
    with context.open_protected(dm):
        dm.flatten()
        info, sent = dm.info, dm.sent_count
    context.show(f"{info.model} {info.serial}: flat after {sent} commands")
    context.report(simulated=info.simulated, serial=info.serial, changed=True, commands=sent)


# Otherwise a negative amplitude is parsed as an option.
@app.command("poke", cls=DeviceCommand, context_settings={"ignore_unknown_options": True})
@command("dm poke", quiet=True)
def poke(
    context: CommandContext,
    selection: options.DeviceSelection,
    actuator: Annotated[int, typer.Argument(min=0, help="Number of the actuator, counted from 0.")],
    amplitude: Annotated[float, typer.Argument(help="Fraction of full stroke, such as 0.05.")],
    seconds: Seconds = 1.0,
) -> None:
    """Poke one actuator for a while: MOVES the mirror, flat before and after."""
    from escape_hw.runtime.host.device_tools import hold_shape, poke_shape

    check_number("amplitude", amplitude, -1, 1, "of full stroke")
    chosen = _mirror(context, selection)
    dm = chosen.device
    _require_legal(chosen, lambda mirror: poke_shape(mirror, actuator, amplitude))
    chosen.announce_change(context, f"flat, then actuator {actuator} by {amplitude:g} for {seconds:g} s")
    _preserve_floating(dm)
    with context.open_protected(dm):
        shape = poke_shape(dm, actuator, amplitude)
        dm.flatten()
        motion = context.run(hold_shape(dm, shape, seconds))
        info = dm.info
    asked = {"actuator": actuator, "amplitude": amplitude, "seconds": seconds}
    context.show(f"{info.model} {info.serial}: actuator {actuator} by {amplitude:g}, then flat")
    context.report(simulated=info.simulated, serial=info.serial, changed=True, asked=asked, **asdict(motion))


@app.command("wave", cls=DeviceCommand)
@command("dm wave", quiet=True)
def wave(
    context: CommandContext,
    selection: options.DeviceSelection,
    amplitude: Annotated[float, typer.Option("--amplitude", min=0, max=1, help="Of full stroke.")] = 0.02,
    frequency: Annotated[float, typer.Option("--frequency", min=0.01, max=20, help="Hertz.")] = 0.5,
    waves: Annotated[float, typer.Option("--waves", min=0, max=20, help="Periods across.")] = 2.0,
    seconds: Seconds = 4.0,
) -> None:
    """Run a wave over the mirror: MOVES every actuator, flat before and after.

    Exit code 1: fewer commands were sent than the wave has, because the mirror or this computer is too slow.
    """
    from escape_hw.runtime.host.device_tools import WAVE_HZ, run_wave, wave_generator

    chosen = _mirror(context, selection)
    dm = chosen.device
    _require_legal(chosen, lambda mirror: wave_generator(mirror, amplitude, waves))
    chosen.announce_change(context, f"a wave of {amplitude:g} at {frequency:g} Hz for {seconds:g} s")
    _preserve_floating(dm)
    with context.open_protected(dm):
        dm.flatten()
        motion = context.run(run_wave(dm, wave_generator(dm, amplitude, waves), frequency, seconds))
        info = dm.info
    asked = {"amplitude": amplitude, "frequency_hz": frequency, "waves": waves, "seconds": seconds}
    context.show(
        f"{info.model} {info.serial}: {motion.commands} commands, largest {motion.peak:.4g}, then flat"
    )
    total = motion.commands + motion.missed
    met = motion.missed <= _TOLERATED_MISSES * total
    if not met:
        context.notify(
            f"{motion.missed} of {total} commands were not sent in {seconds:g} s, and the wave was slower "
            f"than {frequency:g} Hz: the mirror or this computer is too slow for {WAVE_HZ:g} commands per "
            "second"
        )
    context.report(
        met, simulated=info.simulated, serial=info.serial, changed=True, asked=asked, **asdict(motion)
    )


@app.command("status", cls=DeviceCommand)
@command("dm status")
def status(context: CommandContext, selection: options.DeviceSelection) -> None:
    """Show properties and limits of the mirror.

    An adaptive secondary is only observed. Any other mirror is opened, and flat when it is closed.
    """
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary

    chosen = _mirror(context, selection)
    dm = chosen.device
    rest: dict[str, Any] = {"health": None}
    if isinstance(dm, AdaptiveSecondary):
        context.devices_opened = True
        health = dm.observe_health()
        rest["health"], changed = asdict(health), False
        context.show(f"{health.state}, gap {health.gap_m * 1e6:.1f} um {health.fault}".rstrip())
    else:
        chosen.announce_change(context, "it is opened, and flattened when it is closed")
        with context.open_protected(dm):
            changed = True
    info, limits = dm.info, dm.limits
    stroke = "unknown" if math.isnan(info.stroke_m) else f"{info.stroke_m * 1e6:g} um"
    context.show(f"{info.model} {info.serial}: {info.n_act} actuators, full stroke {stroke}")
    context.show(f"limits: {', '.join(f'{key} {value}' for key, value in asdict(limits).items())}")
    context.report(
        simulated=info.simulated, changed=changed, model=info.model, serial=info.serial, n_act=info.n_act,
        stroke_m=info.stroke_m, limits=asdict(limits), **rest,
    )  # fmt: skip


def _mirror(context: CommandContext, selection: options.SystemSelection) -> SelectedDevice[DeformableMirror]:
    from escape_hw.api.mirror import DeformableMirror

    return select_device(context, selection, "dm", DeformableMirror)  # type: ignore[type-abstract]


def _preserve_floating(dm: DeformableMirror) -> None:
    """Leave a shell that floats afloat after the command; any other is rested again."""
    from escape_hw.api.adaptive_secondary import AdaptiveSecondary, ShellState

    if isinstance(dm, AdaptiveSecondary):
        dm.leave_set = dm.observe_health().state in (ShellState.SET, ShellState.RUNNING)


def _require_legal(
    chosen: SelectedDevice[DeformableMirror], shape_of: Callable[[DeformableMirror], object]
) -> None:
    """Refuse a shape beyond the limits of the configuration, if there is one, before the device is opened."""
    from escape_hw.runtime.host.device_tools import ConfiguredMirror

    if chosen.config is None:
        return
    with ConfiguredMirror(chosen.config.devices.dm) as mirror:
        try:
            shape_of(mirror)
        except CommandRejected as error:
            raise ConfigError(str(error)) from error
