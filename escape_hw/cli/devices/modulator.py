"""``escape modulator``: start, stop and query the tip-tilt modulator."""

from __future__ import annotations

import shlex
import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import DEVICE_CLOSING, CommandContext
from escape_hw.cli.devices.device_tools import (
    DeviceCommand,
    SelectedDevice,
    check_number,
    select_device,
)
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.api.modulator import Modulation, ModulatorStatus, TipTiltModulator
    from escape_hw.config.devices import ModulatorConfig

app = typer.Typer(
    help="Start, stop or query the tip-tilt modulator; simulated or real.", no_args_is_help=True
)


@app.command("start", cls=DeviceCommand)
@command("modulator start")
def start(
    context: CommandContext,
    selection: options.DeviceSelection,
    radius: Annotated[
        float | None,
        typer.Option("--radius", min=0, help="lambda/D on the pyramid (default: as configured)."),
    ] = None,
    radius_rad: Annotated[
        float | None,
        typer.Option("--radius-rad", min=0, help="Radians of mirror tilt, in place of --radius."),
    ] = None,
    frequency: Annotated[
        float | None, typer.Option("--frequency", help="Frequency, hertz (default: as configured).")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds",
            min=0,
            max=86400,
            help="Modulate for this time, then park (default: keep modulating).",
        ),
    ] = None,
) -> None:
    """Modulate on a circle: MOVES the stage (servos on, auto-zero where needed, centre, circle).

    The stage continues by its own clock after the command; 'escape modulator stop' stops it. A simulated
    one ends with the command.
    """
    chosen = _device(context, selection)
    device, section = chosen.device, chosen.section
    requested = _requested_modulation(chosen, radius, radius_rad, frequency)
    chosen.announce_change(context, "servos on, auto-zero where needed, centre, then the circle")
    with context.open_protected(device, DEVICE_CLOSING):
        achievable = device.check(requested)
        context.notify(f"requested: {_format_modulation(requested, section)}")
        context.notify(f"achievable: {_format_modulation(achievable, section)}")
        device.modulate(requested)
        if seconds is not None:
            time.sleep(seconds)
        status = device.status()
        left = seconds is None and device.release()
    command_line = shlex.join(("escape", "modulator", "stop", *selection.words()))
    final_state = f"modulating; stop it with: {command_line}" if left else "parked"
    context.show(*_format_status(status, section), f"left {final_state}")
    asked = {"frequency_hz": requested.frequency_hz}
    if (radius_lambda_d := _lambda_d(requested, section)) is None:
        asked["radius_rad"] = requested.radius_rad
    else:
        asked["radius_lambda_d"] = radius_lambda_d
    context.report(
        **_status_fields(status, section), asked=asked, foreseen=asdict(achievable),
        left="turning" if left else "parked", changed=True,
    )  # fmt: skip


@app.command("stop", cls=DeviceCommand)
@command("modulator stop")
def stop(context: CommandContext, selection: options.DeviceSelection) -> None:
    """Stop and park: MOVES the stage to its centre, then switches its servos off."""
    chosen = _device(context, selection)
    device, section = chosen.device, chosen.section
    chosen.announce_change(context, "centre, servos off")
    with context.open_protected(device, DEVICE_CLOSING):
        device.park()
        status = device.status()
    context.show(*_format_status(status, section), "left parked")
    context.report(**_status_fields(status, section), left="parked", changed=True)


@app.command("status", cls=DeviceCommand)
@command("modulator status")
def status(context: CommandContext, selection: options.DeviceSelection) -> None:
    """Show the state of the modulator; moves and changes nothing."""
    chosen = _device(context, selection)
    section = chosen.section
    context.devices_opened = True
    now = chosen.device.status()
    context.show(*_format_status(now, section))
    context.report(**_status_fields(now, section), changed=False)


def _device(context: CommandContext, selection: options.SystemSelection) -> SelectedDevice[TipTiltModulator]:
    """The modulator, not open."""
    from escape_hw.api.modulator import TipTiltModulator

    return select_device(context, selection, "modulator", TipTiltModulator)  # type: ignore[type-abstract]


def _requested_modulation(
    chosen: SelectedDevice[TipTiltModulator],
    radius: float | None,
    radius_rad: float | None,
    frequency_hz: float | None,
) -> Modulation:
    """The modulation of the options, completed by the configuration if there is one."""
    from escape_hw.api.modulator import Modulation
    from escape_hw.config.sensor import PyramidSection

    if radius is not None and radius_rad is not None:
        raise ConfigError("--radius and --radius-rad exclude each other; give one")
    frequency_hz = check_number("--frequency", frequency_hz, 1e-3, 5000, "Hz")
    radius_rad = check_number("--radius-rad", radius_rad, 0, 0.1, "rad")
    section: ModulatorConfig | None = chosen.section
    if chosen.config is None or section is None:
        if radius_rad is None or frequency_hz is None:
            raise ConfigError("--radius-rad and --frequency: both are needed with --driver")
        return Modulation(radius_rad, frequency_hz)
    if radius_rad is None:
        radius = chosen.config.sensor_as(PyramidSection).modulation if radius is None else radius
        radius_rad = radius * section.rad_per_lambda_d
    if radius_rad > section.max_tilt_rad:
        raise ConfigError(
            f"a radius of {radius_rad / section.rad_per_lambda_d:.4g} lambda/D tilts the stage by "
            f"{radius_rad:.4g} rad; devices.modulator.max_tilt_rad is {section.max_tilt_rad:g}"
        )
    return Modulation(radius_rad, section.frequency_hz if frequency_hz is None else frequency_hz)


def _lambda_d(modulation: Modulation, section: ModulatorConfig | None) -> float | None:
    """Radius on the pyramid in lambda/D; ``None`` without a system."""
    return None if section is None else modulation.radius_rad / section.rad_per_lambda_d


def _format_modulation(modulation: Modulation, section: ModulatorConfig | None) -> str:
    radius, radius_lambda_d = f"{modulation.radius_rad * 1e6:.4g} urad", _lambda_d(modulation, section)
    if radius_lambda_d is not None:
        radius = f"{radius_lambda_d:.4g} lambda/D ({radius})"
    return f"{radius} at {modulation.frequency_hz:.6g} Hz"


def _format_status(status: ModulatorStatus, section: ModulatorConfig | None) -> list[str]:
    now, at = status.modulation, status.position_rad
    rows = [f"{status.info.model}, serial number {status.info.serial or 'unknown'}"]
    rows.append("at rest" if now is None else f"modulating: {_format_modulation(now, section)}")
    if at is not None:
        rows.append(f"position ({at[0] * 1e6:.4g}, {at[1] * 1e6:.4g}) urad from the centre")
    return [*rows, *(f"{key}: {value}" for key, value in status.details.items())]


def _status_fields(status: ModulatorStatus, section: ModulatorConfig | None) -> dict[str, Any]:
    """The status in the command's document."""
    found = {"simulated": status.info.simulated, "serial": status.info.serial, **asdict(status)}
    if status.modulation is not None:
        found["modulation"]["radius_lambda_d"] = _lambda_d(status.modulation, section)
    return found
