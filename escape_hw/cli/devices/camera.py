"""``escape camera``: record, monitor and configure a camera."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.cli.devices.device_tools import (
    DeviceCommand,
    SelectedDevice,
    check_number,
    select_device,
)
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame, Region
    from escape_hw.config.devices import CameraConfig
    from escape_hw.config.system import SystemConfig

app = typer.Typer(
    help="Record frames of a camera, monitor or configure it; simulated or real.", no_args_is_help=True
)
Which = Annotated[
    Literal["wfs", "science"], typer.Option("--camera", help="Wavefront sensor or science camera.")
]


@app.command("snap", cls=DeviceCommand)
@command("camera snap", quiet=True)
def snap(
    context: CommandContext,
    selection: options.DeviceSelection,
    camera: Which = "wfs",
    frames: Annotated[int, typer.Option("--frames", min=1, max=100000, help="Number of frames.")] = 1,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="FITS file (default: nothing is written).")
    ] = None,
) -> None:
    """Record frames with the settings of the configuration."""
    import numpy as np

    from escape_hw.io.storage import check_writable, make_folder
    from escape_hw.runtime.host.device_tools import grab_frames

    chosen = _camera(context, selection, camera)
    device = chosen.device
    if out is not None:
        if out.exists():
            raise ConfigError(f"{out}: exists; choose another name or remove it")
        make_folder(out.absolute().parent)
        check_writable(out.absolute().parent)
    with context.open_protected(device):
        settings, changed = _apply_configuration(context, chosen)
        frame_list = context.run(grab_frames(device, frames, _timeout_s(chosen)))
        info, status = device.info, device.status()
    if out is not None:
        _save(out, frame_list, info, settings, chosen.config)
    cube = np.stack([frame.data for frame in frame_list])
    counts = {"min": int(cube.min()), "max": int(cube.max()), "mean": float(cube.mean())}
    saturated = max(frame.n_saturated for frame in frame_list)
    context.show(
        f"{info.model} {info.serial}: {len(frame_list)} frames of {cube.shape[2]} x {cube.shape[1]} "
        f"pixels, {status.lost} lost, counts {counts['min']} to {counts['max']}, "
        f"mean {counts['mean']:.1f}, {saturated} saturated",
        *([f"written: {out}"] if out is not None else []),
    )
    context.report(
        simulated=info.simulated, serial=info.serial, changed=changed, camera=camera, frames=len(frame_list),
        shape=cube.shape[1:], counts=counts, saturated=saturated, lost=status.lost,
        first_index=frame_list[0].index, settings=asdict(settings), file=out,
    )  # fmt: skip


@app.command("stream", cls=DeviceCommand)
@command("camera stream", quiet=True)
def stream(
    context: CommandContext,
    selection: options.DeviceSelection,
    camera: Which = "wfs",
    seconds: Annotated[float, typer.Option("--seconds", min=0.01, max=86400, help="Duration.")] = 1.0,
) -> None:
    """Monitor a running camera: rate, lost frames, counts. Exit code 1 when frames were lost."""
    from escape_hw.runtime.host.device_tools import monitor_camera

    chosen = _camera(context, selection, camera)
    device = chosen.device
    with context.open_protected(device):
        settings, changed = _apply_configuration(context, chosen)
        statistics = context.run(monitor_camera(device, seconds, _timeout_s(chosen)))
        info = device.info
    context.show(
        f"{info.model} {info.serial}: {statistics.frames} frames at {statistics.rate_hz:.2f} Hz "
        f"(requested {settings.frame_rate_hz:.2f}), {statistics.status.lost} lost, "
        f"{statistics.status.timeouts} time-outs",
        f"counts {statistics.lowest} to {statistics.highest}, mean {statistics.mean:.1f}, "
        f"{statistics.saturated} saturated",
    )
    context.report(
        simulated=info.simulated, serial=info.serial, changed=changed, camera=camera,
        settings=asdict(settings), **asdict(statistics),
    )  # fmt: skip
    context.code = context.code or int(statistics.status.lost > 0)


@app.command("settings", cls=DeviceCommand)
@command("camera settings")
def settings(
    context: CommandContext,
    selection: options.DeviceSelection,
    camera: Which = "wfs",
    exposure: Annotated[float | None, typer.Option("--exposure", help="Exposure time, seconds.")] = None,
    rate: Annotated[float | None, typer.Option("--frame-rate", help="Frames per second, hertz.")] = None,
    gain: Annotated[float | None, typer.Option("--gain", help="Analogue gain, decibels.")] = None,
    region: Annotated[
        str | None, typer.Option("--region", metavar="X,Y,WIDTH,HEIGHT", help="Region read, pixels.")
    ] = None,
    check: Annotated[
        bool, typer.Option("--check", help="Only check what the camera can do; set nothing.")
    ] = False,
) -> None:
    """Check settings, then set them; shows the settings in force, as TOML to paste."""
    chosen = _camera(context, selection, camera)
    device = chosen.device
    changes = _requested_changes(chosen, exposure, rate, gain, region)
    if not check:
        chosen.announce_change(context, "exposure, frame rate, gain and region")
    with context.open_protected(device):
        base = device.settings if chosen.section is None else chosen.section.settings()
        requested = replace(base, **changes)
        achievable = device.check(requested)
        now = achievable if check else device.configure(requested)
        info = device.info
    context.show(f"[devices.{camera}]", *_format_toml(now))
    if now != requested:
        context.notify(f"requested: {requested}")
    context.report(
        simulated=info.simulated, serial=info.serial, changed=not check, camera=camera,
        asked=asdict(requested), settings=asdict(now), as_asked=now == requested,
    )  # fmt: skip


def _camera(context: CommandContext, selection: options.SystemSelection, key: str) -> SelectedDevice[Camera]:
    from escape_hw.api.camera import Camera

    return select_device(context, selection, key, Camera)  # type: ignore[type-abstract]


def _timeout_s(chosen: SelectedDevice[Camera]) -> float:
    """Longest wait for a frame, seconds; without a system several frames long."""
    if chosen.section is not None:
        return float(chosen.section.timeout_s)
    return max(1.0, 5 / chosen.device.settings.frame_rate_hz)


def _apply_configuration(
    context: CommandContext, chosen: SelectedDevice[Camera]
) -> tuple[CameraSettings, bool]:
    """Apply the configuration to the open camera; the settings in force, and whether they changed."""
    before = chosen.device.settings
    requested = before if chosen.section is None else chosen.section.settings()
    if before == requested:
        return before, False
    chosen.announce_change(context, "the settings of the configuration")
    return chosen.device.configure(requested), True


def _requested_changes(
    chosen: SelectedDevice[Camera],
    exposure: float | None,
    rate: float | None,
    gain: float | None,
    region: str | None,
) -> dict[str, Any]:
    """The settings that the options give, within what any camera has, and this one as configured."""
    changes: dict[str, Any] = {
        "exposure_s": check_number("--exposure", exposure, 1e-6, 60, "s"),
        "frame_rate_hz": check_number("--frame-rate", rate, 0.01, 20000, "Hz"),
        "gain_db": check_number("--gain", gain, 0, 48, "dB"),
        "region": None if region is None else _parse_region(region, chosen.section),
    }
    return {name: value for name, value in changes.items() if value is not None}


def _parse_region(text: str, section: CameraConfig | None) -> Region:
    """A region that lies on the sensor, as far as it is known."""
    from escape_hw.api.camera import Region

    parts = text.split(",")
    if len(parts) != 4 or not all(part.strip().isdecimal() for part in parts):
        raise ConfigError(f"--region {text}: write X,Y,WIDTH,HEIGHT in integer pixels")
    region = Region(*map(int, parts))
    if min(region.width, region.height) < 1:
        raise ConfigError(f"--region {text}: width and height must be at least 1 pixel")
    if section is not None:
        columns, rows = section.sensor_px
        if region.x + region.width > columns or region.y + region.height > rows:
            raise ConfigError(f"--region {text}: does not lie on the sensor of {columns} x {rows} pixels")
    return region


def _format_toml(settings: CameraSettings) -> list[str]:
    r = settings.region
    return [
        f"region = [{r.x}, {r.y}, {r.width}, {r.height}]",
        f"exposure_s = {settings.exposure_s:.9g}",
        f"frame_rate_hz = {settings.frame_rate_hz:.9g}",
        f"gain_db = {settings.gain_db:.9g}",
    ]


def _save(
    out: Path,
    frame_list: list[Frame],
    info: CameraInfo,
    settings: CameraSettings,
    config: SystemConfig | None,
) -> None:
    from escape_hw.io.fits.frames import save_frames
    from escape_hw.io.provenance import Provenance

    name, text, seed = "", "", None
    if config is not None:
        name, text, seed = config.system.name, config.to_toml(), config.system.seed
    origin = Provenance(text, seed=seed, serials={"camera": info.serial})
    save_frames(out, frame_list, info, settings, name, origin)
