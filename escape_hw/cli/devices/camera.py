"""``escape camera``: record, monitor and configure a camera."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import typer

from escape_hw.cli import options
from escape_hw.cli.command import command
from escape_hw.cli.context import CommandContext
from escape_hw.cli.devices.device_tools import announce_change, build_single_device
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame
    from escape_hw.config.devices import CameraConfig
    from escape_hw.config.system import SystemConfig

app = typer.Typer(
    help="Record frames of a camera, monitor or configure it; simulated or real.", no_args_is_help=True
)
Which = Annotated[
    Literal["wfs", "science"], typer.Option("--camera", help="Wavefront sensor or science camera.")
]


@app.command("snap")
@command("camera snap", quiet=True)
def snap(
    context: CommandContext,
    selection: options.Selection,
    camera: Which = "wfs",
    frames: Annotated[int, typer.Option("--frames", min=1, max=100000, help="Number of frames.")] = 1,
    out: Annotated[
        Path | None, typer.Option("--out", metavar="FILE", help="FITS file (default: nothing is written).")
    ] = None,
) -> None:
    """Record frames with the settings of the configuration."""
    import numpy as np

    from escape_hw.runtime.host.device_tools import grab_frames

    config, section, device = _camera(context, selection, camera)
    if out is not None and out.exists():
        raise ConfigError(f"{out}: exists; choose another name or remove it")
    with context.open_protected(device):
        settings, changed = _apply_configuration(context, config, camera, device)
        frame_list = context.run(grab_frames(device, frames, section.timeout_s))
        info, status = device.info, device.status()
    if out is not None:
        _save(out, frame_list, info, settings, config)
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
        simulated=info.simulated, changed=changed, camera=camera, frames=len(frame_list),
        shape=cube.shape[1:], counts=counts, saturated=saturated, lost=status.lost,
        first_index=frame_list[0].index, settings=asdict(settings), file=out,
    )  # fmt: skip


@app.command("stream")
@command("camera stream", quiet=True)
def stream(
    context: CommandContext,
    selection: options.Selection,
    camera: Which = "wfs",
    seconds: Annotated[float, typer.Option("--seconds", min=0.01, max=86400, help="Duration.")] = 1.0,
) -> None:
    """Monitor a running camera: rate, lost frames, counts. Exit code 1 when frames were lost."""
    from escape_hw.runtime.host.device_tools import monitor_camera

    config, section, device = _camera(context, selection, camera)
    with context.open_protected(device):
        settings, changed = _apply_configuration(context, config, camera, device)
        statistics = context.run(monitor_camera(device, seconds, section.timeout_s))
        info = device.info
    context.show(
        f"{info.model} {info.serial}: {statistics.frames} frames at {statistics.rate_hz:.2f} Hz "
        f"(requested {settings.frame_rate_hz:.2f}), {statistics.status.lost} lost, "
        f"{statistics.status.timeouts} time-outs",
        f"counts {statistics.lowest} to {statistics.highest}, mean {statistics.mean:.1f}, "
        f"{statistics.saturated} saturated",
    )
    context.report(
        simulated=info.simulated, changed=changed, camera=camera, settings=asdict(settings),
        **asdict(statistics),
    )  # fmt: skip
    context.code = context.code or int(statistics.status.lost > 0)


@app.command("settings")
@command("camera settings")
def settings(
    context: CommandContext,
    selection: options.Selection,
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
    config, section, device = _camera(context, selection, camera)
    requested = _requested_settings(section.settings(), exposure, rate, gain, region)
    if not check:
        announce_change(context, config, camera, "exposure, frame rate, gain and region")
    with context.open_protected(device):
        achievable = device.check(requested)
        now = achievable if check else device.configure(requested)
        info = device.info
    context.show(f"[devices.{camera}]", *_format_toml(now))
    if now != requested:
        context.notify(f"requested: {requested}")
    context.report(
        simulated=info.simulated, changed=not check, camera=camera, asked=asdict(requested),
        settings=asdict(now), as_asked=now == requested,
    )  # fmt: skip


def _camera(
    context: CommandContext, selection: options.SystemSelection, key: str
) -> tuple[SystemConfig, CameraConfig, Camera]:
    from escape_hw.api.camera import Camera

    config, device = build_single_device(context, selection, key, Camera)  # type: ignore[type-abstract]
    section: CameraConfig = getattr(config.devices, key)
    return config, section, device


def _apply_configuration(
    context: CommandContext, config: SystemConfig, key: str, device: Camera
) -> tuple[CameraSettings, bool]:
    """Apply the configuration to the open camera; the settings in force, and whether they changed."""
    before, requested = device.settings, getattr(config.devices, key).settings()
    if before == requested:
        return before, False
    announce_change(context, config, key, "the settings of the configuration")
    return device.configure(requested), True


def _requested_settings(
    base: CameraSettings, exposure: float | None, rate: float | None, gain: float | None, region: str | None
) -> CameraSettings:
    """The configured settings with the options applied."""
    from escape_hw.api.camera import Region

    if region is not None:
        parts = region.split(",")
        if len(parts) != 4 or not all(part.strip().isdigit() for part in parts):
            raise ConfigError(f"--region {region}: write X,Y,WIDTH,HEIGHT in integer pixels")
        base = replace(base, region=Region(*map(int, parts)))
    return replace(
        base,
        exposure_s=base.exposure_s if exposure is None else exposure,
        frame_rate_hz=base.frame_rate_hz if rate is None else rate,
        gain_db=base.gain_db if gain is None else gain,
    )


def _format_toml(settings: CameraSettings) -> list[str]:
    r = settings.region
    return [
        f"region = [{r.x}, {r.y}, {r.width}, {r.height}]",
        f"exposure_s = {settings.exposure_s:.9g}",
        f"frame_rate_hz = {settings.frame_rate_hz:.9g}",
        f"gain_db = {settings.gain_db:.9g}",
    ]


def _save(
    out: Path, frame_list: list[Frame], info: CameraInfo, settings: CameraSettings, config: SystemConfig
) -> None:
    from escape_hw.io.fits.frames import save_frames
    from escape_hw.io.provenance import Provenance

    origin = Provenance(config.to_toml(), seed=config.system.seed, serials={"camera": info.serial})
    save_frames(out, frame_list, info, settings, config.system.name, origin)
