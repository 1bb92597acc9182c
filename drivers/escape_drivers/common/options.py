"""A driver's own settings, from the ``options`` table of its device section."""

from __future__ import annotations

import difflib
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeVar, get_args, get_type_hints

from escape_hw.errors import ConfigError

if TYPE_CHECKING:
    from escape_hw.config.devices import CameraConfig, DeviceConfig
    from escape_hw.config.system import SystemConfig

Options = TypeVar("Options")


def parse_options(kind: type[Options], device: str, section: DeviceConfig) -> Options:
    """The options of a device section as the driver's dataclass.

    Parameters
    ----------
    kind
        A dataclass whose fields are ``str``, ``int``, ``float``, ``bool`` or a ``Literal`` of such,
        each with a default.
    device
        Key of the device in ``[devices]``.
    section
        Its section.

    Raises
    ------
    ConfigError
        Every unknown option (with the nearest one) and every value of a wrong type, at once.
    """
    hints = get_type_hints(kind)
    problems, values = [], {}
    for key, value in section.options.items():
        where = f"devices.{device}.options.{key}"
        if key not in hints:
            near = difflib.get_close_matches(key, hints, n=1)
            hint = f"did you mean '{near[0]}'? " if near else ""
            problems.append(f"{where}: unknown option ({hint}there are: {', '.join(hints)})")
            continue
        try:
            values[key] = _coerce_value(hints[key], value)
        except ValueError as error:
            problems.append(f"{where}: {value!r}  {error}")
    if problems:
        raise ConfigError("\n".join(problems))
    return kind(**values)


def require_in_range(device: str, options: object, ranges: Mapping[str, tuple[float, float]]) -> None:
    """Check numbers among the options of a device.

    Parameters
    ----------
    ranges
        Smallest and largest value of each.

    Raises
    ------
    ConfigError
        Every number that is out of its range, at once.
    """
    wrong = [
        f"devices.{device}.options.{key}: {value:g}  is out of range (allowed range {low:g} to {high:g})"
        for key, (low, high) in ranges.items()
        if not low <= (value := getattr(options, key)) <= high
    ]
    if wrong:
        raise ConfigError("\n".join(wrong))


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


def require_serial(device: str, section: DeviceConfig) -> str:
    """The serial number, without which no hardware is opened.

    Raises
    ------
    ConfigError
        The section has none.
    """
    if not section.serial.strip():
        raise ConfigError(
            f"devices.{device}.serial: ''  a real device is opened by its serial number only; enter it"
        )
    return section.serial.strip()


def _coerce_value(kind: Any, value: Any) -> Any:
    allowed = get_args(kind)
    if allowed:
        if value not in allowed or isinstance(value, bool) != isinstance(allowed[0], bool):
            raise ValueError(f"must be one of {', '.join(map(repr, allowed))}")
        return value
    if kind is float and isinstance(value, int) and not isinstance(value, bool):
        return float(value)
    if type(value) is not kind:
        raise ValueError(f"must be of type {kind.__name__}")
    return value
