"""Streams of pyRTC and of milk as deformable mirrors."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from escape_drivers.common.options import parse_options
from escape_drivers.streams.source import Opener, open_milk, open_pyrtc, open_stream, with_stream_serial
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.config.section import Section
from escape_hw.errors import DeviceError
from escape_hw.io.interchange.stream import Stream

if TYPE_CHECKING:
    from escape_hw.config.devices import MirrorConfig
    from escape_hw.config.system import SystemConfig


class StreamMirrorOptions(Section):
    """The ``[devices.dm.options]`` of these drivers.

    Parameters
    ----------
    stream
        Name of the stream.
    scale
        What the stream holds for a command of 1, full stroke.
    simulated
        The stream is read by a simulator; results are marked as simulated.
    """

    stream: str = ""
    scale: float = Field(1.0, ge=1e-12, le=1e12)
    simulated: bool = False


def make_pyrtc_mirror(name: str, config: SystemConfig, shared: dict[str, object]) -> StreamMirror:
    """Entry point ``pyrtc-mirror``.."""
    return _build(name, config, open_pyrtc, "pyRTC stream")


def make_milk_mirror(name: str, config: SystemConfig, shared: dict[str, object]) -> StreamMirror:
    """Entry point ``milk-mirror``.."""
    return _build(name, config, open_milk, "milk image")


def _build(name: str, config: SystemConfig, opener: Opener, kind: str) -> StreamMirror:
    """Raises ``ConfigError`` when the stream is missing or an option is wrong."""
    section = config.devices.dm
    options = parse_options(StreamMirrorOptions, name, section)
    return StreamMirror(name, with_stream_serial(name, section, options.stream), options, opener, kind)


class StreamMirror(DeformableMirror):
    """A mirror whose commands another program reads and sends.

    The stream holds one number per actuator, or a map of the actuator layout.
    There is no acknowledgement: a command counts as sent when it is published.
    """

    def __init__(
        self, name: str, section: MirrorConfig, options: StreamMirrorOptions, opener: Opener, kind: str
    ) -> None:
        super().__init__(name, section.limits.to_limits())
        self._section, self._options, self._opener, self._kind = section, options, opener, kind
        self._stream: Stream | None = None
        self._scaled_command, self._buffer = np.zeros(section.n_act), np.zeros(section.n_act)
        # Where the buffer holds the actuators; all of it, but for a map.
        self._actuator_indices: NDArray[np.intp] | slice = slice(None)
        self._flat_buffer = self._buffer

    @property
    def info(self) -> DMInfo:
        """Identity and geometry."""
        return self._section.info(f"{self._kind} {self._options.stream}", simulated=self._options.simulated)

    def _open(self) -> None:
        stream = self._stream = open_stream(self.name, self._opener, self._options.stream, write=True)
        layout = self._section.actuator_map()
        if stream.shape == (self._section.n_act,):
            self._actuator_indices = slice(None)
        elif layout is not None and stream.shape == layout.shape:
            self._actuator_indices = np.flatnonzero(layout)
        else:
            wanted = f"({self._section.n_act},)" + ("" if layout is None else f" or {layout.shape}")
            raise DeviceError(
                self.name,
                f"stream '{stream.name}' has shape {stream.shape}; the layout {self._section.layout!r} needs "
                f"{wanted}",
            )
        self._buffer = np.zeros(stream.shape)
        self._flat_buffer = self._buffer.reshape(-1)

    def _close(self) -> None:
        stream, self._stream = self._stream, None
        if stream is not None:
            stream.close()

    def _release_after_failed_open(self) -> None:
        self._close()

    def _send(self, command: NDArray[np.float64]) -> None:
        if self._stream is None:
            raise DeviceError(self.name, "is not connected; call open() first")
        np.multiply(command, self._options.scale, out=self._scaled_command)
        self._flat_buffer[self._actuator_indices] = self._scaled_command
        try:
            self._stream.write(self._buffer)
        except (RuntimeError, OSError) as error:
            raise DeviceError(
                self.name, f"stream '{self._options.stream}' takes no command ({error})"
            ) from error
