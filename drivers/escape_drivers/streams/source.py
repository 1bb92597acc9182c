"""Configuration of a stream that replaces a device."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, NamedTuple, TypeVar

import numpy as np

from escape_drivers.common.options import serial_text
from escape_hw.errors import ConfigError, DeviceError, EscapeError
from escape_hw.io.interchange.milk.stream import MilkStream
from escape_hw.io.interchange.pyrtc.stream import ShmemStream
from escape_hw.io.interchange.stream import Stream

if TYPE_CHECKING:
    from escape_hw.config.devices import DeviceConfig

S = TypeVar("S", bound="DeviceConfig")


class StreamSource(NamedTuple):
    """Software whose streams replace devices: what a stream is called in ``info``, and how it is opened."""

    kind: str
    #: Opens a stream by its name, for reading or for writing.
    open: Callable[[str, bool], Stream]


PYRTC = StreamSource("pyRTC stream", lambda name, write: ShmemStream.open(name, write=write))
MILK = StreamSource("milk image", lambda name, write: MilkStream.open(name))


def open_stream(device: str, source: StreamSource, name: str, *, write: bool) -> Stream:
    """Open a stream for a device.

    Raises
    ------
    DeviceError
        The stream cannot be opened or does not contain numbers.
    """
    try:
        stream = source.open(name, write)
    except EscapeError as error:
        raise DeviceError(device, str(error)) from error
    if np.dtype(stream.dtype).kind not in "iuf":
        stream.close()
        raise DeviceError(device, f"stream '{name}' holds {stream.dtype}; real numbers are needed")
    return stream


def stream_serial(where: str, serial: str | int, stream: str) -> str:
    """A serial number; without one, the stream's name is used.

    Raises
    ------
    ConfigError
        No stream is named; ``where`` is the key.
    """
    # A name that is no text is reported with the other options.
    if not str(stream).strip():
        raise ConfigError(f"{where}: ''  names no stream that could stand for the device; enter it")
    return serial_text("serial", serial) or f"stream {stream}"


def with_stream_serial(device: str, section: S, options: Mapping[str, object]) -> S:
    """A device section with a serial number, which is the stream's name where it has none."""
    where = f"devices.{device}.options.stream"
    serial = stream_serial(where, section.serial, str(options.get("stream", "")))
    return section.model_copy(update={"serial": serial})
