"""``escape modulator``: hands on the tip-tilt modulator, without any calibration."""

from __future__ import annotations

import time
from dataclasses import asdict
from typing import TYPE_CHECKING, Annotated, Any

import typer

from escape_hw.cli import options
from escape_hw.cli.hands import opened
from escape_hw.cli.session import Session, session

if TYPE_CHECKING:
    from escape_hw.api.modulator import Modulation, ModulatorStatus, TipTiltModulator
    from escape_hw.config.device_models import ModulatorConfig
    from escape_hw.config.models import SystemConfig

app = typer.Typer(help="Start, stop or ask the tip-tilt modulator, on twin and metal.", no_args_is_help=True)


@app.command("start")
def start(
    system: options.System,
    radius: Annotated[
        float | None,
        typer.Option("--radius", min=0, help="lambda/D on the pyramid (default: as configured)."),
    ] = None,
    frequency: Annotated[
        float | None, typer.Option("--frequency", help="Turns per second, hertz (default: as configured).")
    ] = None,
    seconds: Annotated[
        float | None,
        typer.Option("--seconds", min=0, help="Turn for so long, then park (default: leave it turning)."),
    ] = None,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Turn the beam in a circle: MOVES the stage (servos on, auto-zero where needed, centre, circle).

    The stage goes on turning by its own clock when the command has ended; 'escape modulator stop' ends
    that. A twin ends with the command.
    """
    with session("modulator start", json=json) as one:
        from escape_hw.api.modulator import Modulation

        config, section, device = _device(one, options.Choice.of(system, set, seed, mode))
        lambdas = _configured_radius(config) if radius is None else radius
        want = Modulation(lambdas * section.rad_per_lambda_d, frequency or section.frequency_hz)
        _warn(one, config, "servos on, auto-zero where needed, centre, then the circle")
        with opened(one, device):
            foreseen = device.check(want)
            one.tell(f"asked for {_words(want, section)}; it does {_words(foreseen, section)}")
            device.modulate(want)
            if seconds is not None:
                time.sleep(seconds)
            status = device.status()
            left = seconds is None and device.release()
        fate = "turning; stop it with: escape modulator stop" if left else "parked"
        one.show(*_lines(status, section), f"left {fate}")
        asked = {"radius_lambda_d": lambdas, "frequency_hz": want.frequency_hz}
        told = {"asked": asked, "foreseen": asdict(foreseen), "left": "turning" if left else "parked"}
        one.result({**_document("start", config, status, section), **told, "changed": True})


@app.command("stop")
def stop(
    system: options.System,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Stop and park: MOVES the stage to its centre, then switches its servos off."""
    with session("modulator stop", json=json) as one:
        config, section, device = _device(one, options.Choice.of(system, set, seed, mode))
        _warn(one, config, "centre, servos off")
        with opened(one, device):
            device.park()
            status = device.status()
        one.show(*_lines(status, section), "left parked")
        one.result({**_document("stop", config, status, section), "left": "parked", "changed": True})


@app.command("status")
def status(
    system: options.System,
    set: options.Set = None,
    seed: options.Seed = None,
    mode: options.Mode = None,
    json: options.Json = False,
) -> None:
    """Tell what the modulator does; moves and changes nothing."""
    with session("modulator status", json=json) as one:
        config, section, device = _device(one, options.Choice.of(system, set, seed, mode))
        one.was_opened = True
        now = device.status()
        one.show(*_lines(now, section))
        one.result({**_document("status", config, now, section), "changed": False})


def _device(one: Session, choice: options.Choice) -> tuple[SystemConfig, ModulatorConfig, TipTiltModulator]:
    """The system's modulator, not open.

    Raises
    ------
    ConfigError
        The system has none, or its driver is not installed.
    """
    from escape_hw.api.modulator import TipTiltModulator
    from escape_hw.bench import build_device
    from escape_hw.errors import ConfigError

    config = one.configured(choice)
    section = config.devices.modulator
    if section is None:
        raise ConfigError(f"system '{config.system.name}' has no modulator, [devices.modulator]")
    return config, section, build_device("modulator", config, TipTiltModulator)  # type: ignore[type-abstract]


def _warn(one: Session, config: SystemConfig, what: str) -> None:
    """Say what is about to change on hardware."""
    from escape_hw.bench import mode_of

    section = config.devices.modulator
    if section is not None and mode_of(section, config) == "hardware":
        one.tell(f"this moves the modulator: {what}")


def _configured_radius(config: SystemConfig) -> float:
    """Radius of the modulation in lambda/D as the sensor's section has it."""
    from escape_hw.config.sensor_models import PyramidSection

    return config.sensor_as(PyramidSection).modulation


def _words(modulation: Modulation, section: ModulatorConfig) -> str:
    lambdas = modulation.radius_rad / section.rad_per_lambda_d
    return (
        f"{lambdas:.4g} lambda/D ({modulation.radius_rad * 1e6:.4g} urad) at {modulation.frequency_hz:.6g} Hz"
    )


def _lines(status: ModulatorStatus, section: ModulatorConfig) -> list[str]:
    """A status for people."""
    now, at = status.modulation, status.position_rad
    rows = [f"{status.info.model}, serial number {status.info.serial or 'unknown'}"]
    rows.append("at rest" if now is None else f"turning: {_words(now, section)}")
    if at is not None:
        rows.append(f"now at ({at[0] * 1e6:.4g}, {at[1] * 1e6:.4g}) urad from the centre")
    return [*rows, *(f"{key}: {value}" for key, value in status.details.items())]


def _document(
    command: str, config: SystemConfig, status: ModulatorStatus, section: ModulatorConfig
) -> dict[str, Any]:
    """A status for programs."""
    from escape_hw.io.documents import head

    document: dict[str, Any] = head(
        f"modulator {command}", config.system.name, status.info.simulated, config.system.seed
    )
    found = asdict(status)
    if status.modulation is not None:
        found["modulation"]["radius_lambda_d"] = status.modulation.radius_rad / section.rad_per_lambda_d
    return {**document, **found}
