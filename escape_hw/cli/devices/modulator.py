"""``escape modulator``: start, stop and query the tip-tilt modulator."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.cli.devices.device_tools import announce_change
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.api.modulator import Modulation, ModulatorStatus, TipTiltModulator
    from escape_hw.config.devices import ModulatorConfig
    from escape_hw.config.system import SystemConfig

app = typer.Typer(
    help="Start, stop or query the tip-tilt modulator; simulated or real.", no_args_is_help=True
)


@app.command("start")
@command("modulator start")
def start(
    context: CommandContext,
    selection: options.Selection,
    radius: Annotated[
        float | None,
        typer.Option("--radius", min=0, help="lambda/D on the pyramid (default: as configured)."),
    ] = None,
    frequency: Annotated[
        float | None, typer.Option("--frequency", help="Frequency, hertz (default: as configured).")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option(
            "--seconds", min=0, help="Modulate for this time, then park (default: keep modulating)."
        ),
    ] = None,
) -> None:
    """Modulate on a circle: MOVES the stage (servos on, auto-zero where needed, centre, circle).

    The stage continues by its own clock after the command; 'escape modulator stop' stops it. A simulated
    one ends with the command.
    """
    from escape_hw.api.modulator import Modulation
    from escape_hw.config.sensor import PyramidSection

    config, section, device = _device(context, selection)
    radius_lambda_d = config.sensor_as(PyramidSection).modulation if radius is None else radius
    requested = Modulation(radius_lambda_d * section.rad_per_lambda_d, frequency or section.frequency_hz)
    announce_change(
        context, config, "modulator", "servos on, auto-zero where needed, centre, then the circle"
    )
    with context.open_protected(device):
        achievable = device.check(requested)
        context.notify(f"requested: {_format_modulation(requested, section)}")
        context.notify(f"achievable: {_format_modulation(achievable, section)}")
        device.modulate(requested)
        if seconds is not None:
            time.sleep(seconds)
        status = device.status()
        left = seconds is None and device.release()
    final_state = "modulating; stop it with: escape modulator stop" if left else "parked"
    context.show(*_format_status(status, section), f"left {final_state}")
    asked = {"radius_lambda_d": radius_lambda_d, "frequency_hz": requested.frequency_hz}
    context.report(
        **_status_fields(status, section), asked=asked, foreseen=asdict(achievable),
        left="turning" if left else "parked", changed=True,
    )  # fmt: skip


@app.command("stop")
@command("modulator stop")
def stop(context: CommandContext, selection: options.Selection) -> None:
    """Stop and park: MOVES the stage to its centre, then switches its servos off."""
    config, section, device = _device(context, selection)
    announce_change(context, config, "modulator", "centre, servos off")
    with context.open_protected(device):
        device.park()
        status = device.status()
    context.show(*_format_status(status, section), "left parked")
    context.report(**_status_fields(status, section), left="parked", changed=True)


@app.command("status")
@command("modulator status")
def status(context: CommandContext, selection: options.Selection) -> None:
    """Show the state of the modulator; moves and changes nothing."""
    _, section, device = _device(context, selection)
    context.devices_opened = True
    now = device.status()
    context.show(*_format_status(now, section))
    context.report(**_status_fields(now, section), changed=False)


def _device(
    context: CommandContext, selection: options.SystemSelection
) -> tuple[SystemConfig, ModulatorConfig, TipTiltModulator]:
    """The system's modulator, not open."""
    from escape_hw.api.modulator import TipTiltModulator
    from escape_hw.bench import build_device

    config = context.load_config(selection)
    section = config.devices.modulator
    if section is None:
        raise ConfigError(f"system '{config.system.name}' has no modulator, [devices.modulator]")
    return config, section, build_device("modulator", config, TipTiltModulator)  # type: ignore[type-abstract]


def _format_modulation(modulation: Modulation, section: ModulatorConfig) -> str:
    radius_lambda_d = modulation.radius_rad / section.rad_per_lambda_d
    radius = f"{radius_lambda_d:.4g} lambda/D ({modulation.radius_rad * 1e6:.4g} urad)"
    return f"{radius} at {modulation.frequency_hz:.6g} Hz"


def _format_status(status: ModulatorStatus, section: ModulatorConfig) -> list[str]:
    now, at = status.modulation, status.position_rad
    rows = [f"{status.info.model}, serial number {status.info.serial or 'unknown'}"]
    rows.append("at rest" if now is None else f"modulating: {_format_modulation(now, section)}")
    if at is not None:
        rows.append(f"position ({at[0] * 1e6:.4g}, {at[1] * 1e6:.4g}) urad from the centre")
    return [*rows, *(f"{key}: {value}" for key, value in status.details.items())]


def _status_fields(status: ModulatorStatus, section: ModulatorConfig) -> dict[str, Any]:
    """The status in the command's document."""
    found = {"simulated": status.info.simulated, **asdict(status)}
    if status.modulation is not None:
        found["modulation"]["radius_lambda_d"] = status.modulation.radius_rad / section.rad_per_lambda_d
    return found
