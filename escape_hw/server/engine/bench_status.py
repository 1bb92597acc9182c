"""Devices, illumination and geometry of a bench, as documents for clients."""

from __future__ import annotations

from collections.abc import Mapping

from escape_hw.api.camera import Frame
from escape_hw.api.device import Device
from escape_hw.api.sensor import SensorGeometry
from escape_hw.bench import Bench
from escape_hw.remote.state import DeviceHealth, DeviceState, Geometry, Illumination
from escape_hw.runtime.session.record import actuator_layout, actuator_positions

Facts = dict[str, float | str]


def device_states(bench: Bench, device_messages: Mapping[str, str]) -> tuple[DeviceState, ...]:
    """State of every device; ``device_messages`` holds their problems by name."""
    return tuple(
        _device(name, kind, getattr(bench, name), device_messages)
        for name, kind in (
            ("dm", "deformable mirror"),
            ("wfs", "wavefront sensor camera"),
            ("modulator", "modulator"),
            ("science", "science camera"),
            ("screen", "phase screen"),
        )
        if getattr(bench, name) is not None
    )


def _device(name: str, kind: str, device: Device, device_messages: Mapping[str, str]) -> DeviceState:
    message = device_messages.get(name, "")
    if not device.is_open:
        health = DeviceHealth.LOST if message else DeviceHealth.CLOSED
        return DeviceState(
            name=name, kind=kind, model="", serial="", simulated=False, health=health, message=message
        )
    info = device.info  # type: ignore[attr-defined]
    return DeviceState(
        name=name, kind=kind, model=info.model, serial=info.serial, simulated=bool(info.simulated),
        health=DeviceHealth.STALE if message else DeviceHealth.OK, facts=_facts(device), message=message,
    )  # fmt: skip


def _facts(device: Device) -> Facts:
    info = device.info  # type: ignore[attr-defined]
    settings = getattr(device, "settings", None)
    if settings is not None:
        return {
            "frame_rate_hz": float(settings.frame_rate_hz),
            "exposure_ms": 1e3 * float(settings.exposure_s),
            "pixels": f"{settings.region.width} x {settings.region.height}",
        }
    if hasattr(info, "n_act"):
        return {"actuators": float(info.n_act), "stroke_um": 1e6 * float(info.stroke_m)}
    return {}


def illumination_of(frame: Frame, full_scale: int) -> Illumination:
    """Saturation and peak of a frame."""
    return Illumination(
        saturated=frame.n_saturated / frame.data.size, peak=float(frame.data.max()) / full_scale
    )


def geometry_of(bench: Bench, grid: SensorGeometry | None) -> Geometry:
    """Positions of the sub-apertures and actuators."""
    valid = () if grid is None else tuple("".join("1" if one else "0" for one in row) for row in grid.valid)
    return Geometry(
        valid=valid,
        layout=actuator_layout(bench),
        positions_m=actuator_positions(bench),
        outlines_px=() if grid is None else grid.outlines(),
        n_modes=bench.config.basis.n_modes,
    )
