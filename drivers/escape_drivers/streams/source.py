"""Configuration of a stream that replaces a device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from escape_hw.errors import ConfigError, DeviceError, EscapeError
from escape_hw.io.interchange.milk.stream import MilkStream
from escape_hw.io.interchange.pyrtc.stream import ShmemStream
from escape_hw.io.interchange.stream import Stream

if TYPE_CHECKING:
    from escape_hw.config.devices import DeviceConfig

S = TypeVar("S", bound="DeviceConfig")

#: Opens a stream by its name, for reading or for writing.
Opener = Callable[[str, bool], Stream]


def open_pyrtc(name: str, write: bool) -> Stream:
    """Open a stream of pyRTC's."""
    return ShmemStream.open(name, write=write)


def open_milk(name: str, write: bool) -> Stream:
    """Open an image of milk's."""
    return MilkStream.open(name)


def open_stream(device: str, opener: Opener, name: str, *, write: bool) -> Stream:
    """Open a stream for a device.

    Raises
    ------
    DeviceError
        The stream cannot be opened or does not contain numbers.
    """
    try:
        stream = opener(name, write)
    except EscapeError as error:
        raise DeviceError(device, str(error)) from error
    if np.dtype(stream.dtype).kind not in "iuf":
        stream.close()
        raise DeviceError(device, f"stream '{name}' holds {stream.dtype}; real numbers are needed")
    return stream


def stream_serial(where: str, serial: str, stream: str) -> str:
    """A serial number; without one, the stream's name is used.

    Raises
    ------
    ConfigError
        No stream is named; ``where`` is the key.
    """
    if not stream.strip():
        raise ConfigError(f"{where}: ''  names no stream that could stand for the device; enter it")
    return serial.strip() or f"stream {stream}"


def with_stream_serial(device: str, section: S, options: Mapping[str, object]) -> S:
    """A device section with a serial number, which is the stream's name where it has none."""
    where = f"devices.{device}.options.stream"
    serial = stream_serial(where, section.serial, str(options.get("stream", "")))
    return section.model_copy(update={"serial": serial})
