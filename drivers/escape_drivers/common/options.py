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


def _round(*rows: int) -> str:
    """A round layout with as many rows as columns, from its first rows up to the widest."""
    *first, widest = rows
    middle = [widest] * (widest - 2 * len(first))
    return "rows:" + ",".join(map(str, [*first, *middle, *reversed(first)]))


#: Layouts by the number of actuators: adaptive secondaries, and ALPAO's mirrors that are no ``circle-N``. The
#: rows of these are in ``alpao_dms_data/configuration.ini`` of the public repository ekarus of
#: ArcetriAdaptiveOptics (commit 24c67bac), those of 277 actuators also in REVOLT's public configuration.
_KNOWN_LAYOUTS = {
    336: "maps-336",
    672: "rings-672",
    241: _round(7, 11, 13, 15, 15, 17),
    277: _round(7, 9, 11, 13, 15, 17, 19),
    468: _round(8, 12, 16, 18, 20, 20, 22, 22, 24),
    820: _round(10, 14, 18, 20, 22, 24, 26, 28, 28, 30, 30, 32),
}


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


def serial_text(where: str, serial: str | int) -> str:
    """A serial number without spaces around it; it may be empty.

    Raises
    ------
    ConfigError
        It is neither text nor a whole number; ``where`` names the key.
    """
    if isinstance(serial, bool) or not isinstance(serial, str | int):
        raise ConfigError(f"{where}: {serial!r}  must be text or a whole number")
    return str(serial).strip()


def require_serial(where: str, serial: str | int) -> str:
    """As :func:`serial_text`; without a serial number, no hardware is opened.

    Raises
    ------
    ConfigError
        There is none.
    """
    text = serial_text(where, serial)
    if not text:
        raise ConfigError(f"{where}: ''  a real device is opened by its serial number only; enter it")
    return text


def known_layout(n_act: int) -> str:
    """The layout of a mirror that reports nothing but the number of its actuators; empty if none is known."""
    if n_act in _KNOWN_LAYOUTS:
        return _KNOWN_LAYOUTS[n_act]
    circles = (f"circle-{rows}" for rows in range(2, 100))
    return next((circle for circle in circles if n_actuators(circle) == n_act), "")


def layout_of(device: str, n_act: int) -> str:
    """As :func:`known_layout`.

    Raises
    ------
    DeviceError
        No known layout has so many.
    """
    layout = known_layout(n_act)
    if not layout:
        raise DeviceError(
            device,
            f"has {n_act} actuators, and no known layout has so many; give its layout "
            "(layout='square-N', or a system file)",
        )
    return layout
