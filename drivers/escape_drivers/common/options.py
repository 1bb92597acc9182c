"""A driver's own settings, from the ``options`` table of its device section."""

from __future__ import annotations

import difflib
from typing import TYPE_CHECKING, TypeVar

from pydantic import ValidationError
from pydantic_core import ErrorDetails

from escape_hw.config.key_tree import range_text
from escape_hw.config.section import Section
from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.config.devices import CameraConfig, DeviceConfig
    from escape_hw.config.system import SystemConfig

Options = TypeVar("Options", bound=Section)


def parse_options(kind: type[Options], device: str, section: DeviceConfig) -> Options:
    """The options of the section ``devices.DEVICE``.

    Raises
    ------
    ConfigError
        Every unknown option (with the nearest one) and every wrong value, at once.
    """
    try:
        return kind.model_validate(section.options)
    except ValidationError as error:
        problems = (_describe(kind, device, detail) for detail in error.errors(include_url=False))
        raise ConfigError("\n".join(problems)) from None


def _describe(kind: type[Section], device: str, detail: ErrorDetails) -> str:
    key, fields = str(detail["loc"][0]), kind.model_fields
    where = f"devices.{device}.options.{key}"
    if key not in fields:
        near = difflib.get_close_matches(key, fields, n=1)
        hint = f"did you mean '{near[0]}'? " if near else ""
        return f"{where}: unknown option ({hint}there are: {', '.join(fields)})"
    allowed = range_text(fields[key])
    outside = detail["type"].startswith(("greater_than", "less_than"))
    message = "is out of range" if outside else detail["msg"].replace("Input should be", "must be")
    return f"{where}: {detail['input']!r}  {message}{f' (allowed range {allowed})' if allowed else ''}"


def camera_section(device: str, config: SystemConfig) -> CameraConfig:
    """The section of one of the cameras.

    Raises
    ------
    ConfigError
        The system has no such camera.
    """
    section = {"wfs": config.devices.wfs, "science": config.devices.science}.get(device)
    if section is None:
        raise ConfigError(f"devices.{device}: system '{config.system.name}' has no such camera")
    return section


def require_serial(device: str, section: DeviceConfig) -> None:
    """Require the serial number, without which no hardware is opened.

    Raises
    ------
    ConfigError
        The section has none.
    """
    if not section.serial.strip():
        raise ConfigError(
            f"devices.{device}.serial: ''  a real device is opened by its serial number only; enter it"
        )
