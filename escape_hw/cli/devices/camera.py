"""``escape camera``: record, monitor and configure a camera."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

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
from escape_hw.errors import ConfigError, EscapeError

if TYPE_CHECKING:
    from escape_hw.api.camera import Camera, CameraInfo, CameraSettings, Frame, Region
    from escape_hw.config.devices import CameraConfig
    from escape_hw.config.system import SystemConfig

app = typer.Typer(
    help="Record frames of a camera, monitor or configure it; simulated or real.", no_args_is_help=True
)
#: Times that a recording is in memory while it is written: its frames, and copies of them.
_COPIES = 4
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
    """Record frames with the settings of the configuration.

    After Ctrl-C or a failure of the camera the frames so far are saved as *.partial.fits.
    """
    import numpy as np

    from escape_hw.runtime.host.device_tools import grab_frames

    chosen = _camera(context, selection, camera)
    device = chosen.device
    _require_room(out, frames, None if chosen.section is None else chosen.section.settings().region)
    recorded: list[Frame] = []
    stop: EscapeError | None = None
    try:
        with context.open_protected(device, DEVICE_CLOSING):
            settings, changed = _apply_configuration(context, chosen)
            info = device.info
            _require_room(out, frames, settings.region)
            try:
                context.run(grab_frames(device, frames, _timeout_s(chosen), recorded))
            finally:
                status = device.status()
    except EscapeError as error:
        # A camera that is lost may fail again while it is closed.
        if not recorded:
            raise
        stop = error
    with context.protect_saving(stop):
        if out is not None:
            out = _save(out, recorded, info, settings, chosen.config, partial=stop is not None)
        cube = np.stack([frame.data for frame in recorded])
        counts = {"min": int(cube.min()), "max": int(cube.max()), "mean": float(cube.mean())}
        saturated = max(frame.n_saturated for frame in recorded)
        context.show(
            f"{info.model} {info.serial}: {len(recorded)} frames of {cube.shape[2]} x {cube.shape[1]} "
            f"pixels, {status.lost} lost, counts {counts['min']} to {counts['max']}, "
            f"mean {counts['mean']:.1f}, {saturated} saturated",
            *([f"written: {out}"] if out is not None else []),
        )
        context.report(
            simulated=info.simulated, serial=info.serial, changed=changed, camera=camera,
            frames=len(recorded), shape=cube.shape[1:], counts=counts, saturated=saturated, lost=status.lost,
            first_index=recorded[0].index, settings=asdict(settings), file=out, partial=stop is not None,
        )  # fmt: skip
    if stop is not None:
        raise stop


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
    with context.open_protected(device, DEVICE_CLOSING):
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
    with context.open_protected(device, DEVICE_CLOSING):
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


def _require_room(out: Path | None, frames: int, region: Region | None) -> None:
    """Refuse a recording that would overwrite a file, or that disk or memory cannot hold.

    Without a system the region is known only when the camera is open.
    """
    from escape_hw.io.fits.file import partial_path
    from escape_hw.io.storage import check_writable, make_folder, refuse_existing
    from escape_hw.runtime.host.computer import Host

    # Counts of 16 bits.
    size = 0 if region is None else 2 * frames * region.width * region.height
    available = Host().available_memory()
    if available is not None and _COPIES * size > available:
        raise ConfigError(
            f"--frames {frames}: {_COPIES * size / 1e6:.0f} MB of memory needed, {available / 1e6:.0f} MB "
            "available; record fewer frames at a time, or a smaller region"
        )
    if out is not None:
        refuse_existing(out, partial_path(out))
        make_folder(out.absolute().parent)
        check_writable(out.absolute().parent, size)


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
    """A region within the sensor; without a system the sensor is not known, and only the form is checked."""
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
    *,
    partial: bool,
) -> Path:
    """Save the frames; returns the file, whose name says if it is ``partial``."""
    from escape_hw.io.fits.frames import save_frames
    from escape_hw.io.provenance import Provenance

    name, text, seed = "", "", None
    if config is not None:
        name, text, seed = config.system.name, config.to_toml(), config.system.seed
    origin = Provenance(text, seed=seed, serials={"camera": info.serial})
    return save_frames(out, frame_list, info, settings, name, origin, partial=partial)
