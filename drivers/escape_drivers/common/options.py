"""Settings of a driver: from its device section, or from the keywords of a device opened alone."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from escape_hw.config.key_tree import range_text
from escape_hw.config.layouts import n_actuators
from escape_hw.config.section import Section
from escape_hw.errors import ConfigError, DeviceError

if TYPE_CHECKING:
    from escape_hw.config.devices import CameraConfig, DeviceConfig, MirrorConfig

Options = TypeVar("Options", bound=Section)

#: Layouts of adaptive secondary mirrors by their number of actuators.
_RINGS = {336: "maps-336", 672: "rings-672"}


def parse_options(kind: type[Options], device: str, options: Mapping[str, Any]) -> Options:
    """The options of a device that is opened alone.

    Raises
    ------
    ConfigError
        Every unknown option (with the nearest one) and every wrong value, at once.
    """
    return _parse(kind, device, options)


def section_options(kind: type[Section], device: str, section: DeviceConfig) -> dict[str, Any]:
    """The options of the section ``devices.DEVICE``, as keywords. Raises as :func:`parse_options`."""
    return _parse(kind, f"devices.{device}.options", section.options).model_dump()


def _parse(kind: type[Options], where: str, options: Mapping[str, Any]) -> Options:
    try:
        return kind.model_validate(dict(options))
    except ValidationError as error:
        problems = (_describe(kind, where, detail) for detail in error.errors(include_url=False))
        raise ConfigError("\n".join(problems)) from None


def _describe(kind: type[Section], where: str, detail: ErrorDetails) -> str:
    key, fields = str(detail["loc"][0]), kind.model_fields
    where = f"{where}.{key}"
    if key not in fields:
        near = difflib.get_close_matches(key, fields, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        return f"{where}: unknown option ({hint}there are: {', '.join(fields)})"
    allowed = range_text(fields[key])
    outside = detail["type"].startswith(("greater_than", "less_than"))
    message = "is out of range" if outside else detail["msg"].replace("Input should be", "must be")
    return f"{where}: {detail['input']!r}  {message}{f' (allowed range {allowed})' if allowed else ''}"


def mirror_settings(device: str, section: MirrorConfig) -> dict[str, Any]:
    """The keys of a mirror's section, as keywords of its class."""
    require_serial(f"devices.{device}.serial", section.serial)
    return {
        "name": device,
        "serial": section.serial,
        "layout": section.layout_in_pitches(),
        "pitch_m": section.pitch_m,
        "stroke_m": section.stroke_m,
        "limits": section.limits.to_limits(),
    }


def camera_settings(device: str, section: CameraConfig) -> dict[str, Any]:
    """The keys of a camera's section, as keywords of its class."""
    require_serial(f"devices.{device}.serial", section.serial)
    keys = ("serial", "sensor_px", "region", "bit_depth", "exposure_s", "frame_rate_hz", "gain_db")
    return {"name": device, **{key: getattr(section, key) for key in keys}}


def require_serial(where: str, serial: str) -> str:
    """The serial number without spaces around it; without one, no hardware is opened.

    Raises
    ------
    ConfigError
        There is none; ``where`` names the key.
    """
    if not serial.strip():
        raise ConfigError(f"{where}: ''  a real device is opened by its serial number only; enter it")
    return serial.strip()


def layout_of(device: str, n_act: int) -> str:
    """The layout of a mirror that reports nothing but the number of its actuators.

    Raises
    ------
    DeviceError
        No known layout has so many.
    """
    if n_act in _RINGS:
        return _RINGS[n_act]
    for rows in range(2, 100):
        if n_actuators(f"circle-{rows}") == n_act:
            return f"circle-{rows}"
    raise DeviceError(
        device,
        f"has {n_act} actuators, and no layout 'circle-N', 'maps-336' or 'rings-672' has so many; give its "
        "layout (layout='square-N', or a system file)",
    )
