"""Streams of pyRTC and of milk as deformable mirrors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, ClassVar, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from escape_drivers.common.mirror import require_geometry
from escape_drivers.common.options import keywords_of, layout_of, mirror_settings, section_options
from escape_drivers.streams.source import (
    MILK,
    PYRTC,
    StreamSource,
    open_stream,
    stream_serial,
    with_stream_serial,
)
from escape_hw.api.mirror import DeformableMirror, DMInfo
from escape_hw.config import layouts
from escape_hw.config.devices import mirror_info
from escape_hw.config.options import parse_limits, parse_options
from escape_hw.config.section import Section
from escape_hw.errors import DeviceError, NotOpen
from escape_hw.io.interchange.stream import Stream
from escape_hw.safety.limits import CAUTIOUS_LIMITS, MirrorLimits

if TYPE_CHECKING:
    from escape_hw.config.devices import MirrorConfig
    from escape_hw.config.registry import DeviceContext


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


class StreamMirror(DeformableMirror):
    """A mirror whose commands another program reads and sends.

    The stream holds one number per actuator, or a map of the actuator layout.
    There is no acknowledgement: a command counts as sent when it is published.

    Parameters
    ----------
    stream
        Name of the stream.
    serial
        Serial number in products; empty: the stream's name.
    name
        Name in messages.
    layout
        Arrangement of the actuators; empty: by the number of elements of the stream.
    pitch_m
        Distance between actuators, metres; by default positions are in pitches.
    stroke_m
        Metres of surface at the actuator for a command of 1; NaN: not known.
    limits
        Limits of every command; a table has those that differ from the cautious ones.
    **options
        Further fields of :class:`StreamMirrorOptions`.

    Raises
    ------
    ConfigError
        No stream is named, or geometry, limits or an option is wrong.
    """

    SOURCE: ClassVar[StreamSource]

    def __init__(
        self,
        stream: str,
        *,
        serial: str | int = "",
        name: str = "dm",
        layout: str = "",
        pitch_m: float = 1.0,
        stroke_m: float = math.nan,
        limits: MirrorLimits | Mapping[str, Any] = CAUTIOUS_LIMITS,
        **options: Any,
    ) -> None:
        super().__init__(name, parse_limits(name, limits))
        self._serial = stream_serial("stream", serial, stream)
        options = {**options, "stream": stream}
        self._options = parse_options(StreamMirrorOptions, name, options, keywords_of(type(self)))
        self._layout = require_geometry(name, layout, pitch_m, stroke_m)
        self._pitch_m, self._stroke_m = pitch_m, stroke_m
        self._info = self._build_info(self._layout) if layout else None
        self._stream: Stream | None = None
        self._scaled_command, self._buffer = np.empty(0), np.empty(0)
        # Where the buffer holds the actuators; all of it, but for a map.
        self._actuator_indices: NDArray[np.intp] | slice = slice(None)
        self._flat_buffer = self._buffer

    @classmethod
    def from_section(cls, section: MirrorConfig, context: DeviceContext) -> Self:
        """The mirror of ``[devices.dm]``; raises ``ConfigError`` as the class does."""
        options = section_options(StreamMirrorOptions, context.name, section)
        section = with_stream_serial(context.name, section, options)
        return cls(**mirror_settings(context.name, section), **options)

    @property
    def info(self) -> DMInfo:
        """Identity and geometry; ``NotOpen`` before ``open`` if no layout was given."""
        if self._info is None:
            raise NotOpen(self.name, "its number of actuators is known once it is open; call open() first")
        return self._info

    def _build_info(self, layout: str) -> DMInfo:
        model = f"{self.SOURCE.kind} {self._options.stream}"
        return mirror_info(
            layout, self._pitch_m, self._stroke_m, model, self._serial, simulated=self._options.simulated
        )

    def _open(self) -> None:
        stream = self._stream = open_stream(self.name, self.SOURCE, self._options.stream, write=True)
        layout = self._layout or layout_of(self.name, math.prod(stream.shape))
        n_act = layouts.n_actuators(layout)
        grid = layouts.layout_map(layout) if layouts.is_on_grid(layout) else None
        if stream.shape == (n_act,):
            self._actuator_indices = slice(None)
        elif grid is not None and stream.shape == grid.shape:
            self._actuator_indices = np.flatnonzero(grid)
        else:
            wanted = f"({n_act},)" + ("" if grid is None else f" or {grid.shape}")
            raise DeviceError(
                self.name,
                f"stream '{stream.name}' has shape {stream.shape}; "
                f"the layout {layouts.shorten(layout)!r} needs {wanted}",
            )
        self._scaled_command, self._buffer = np.zeros(n_act), np.zeros(stream.shape)
        self._flat_buffer = self._buffer.reshape(-1)
        self._info = self._build_info(layout)

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


class PyrtcMirror(StreamMirror):
    """A mirror of pyRTC."""

    SOURCE = PYRTC


class MilkMirror(StreamMirror):
    """A mirror of milk or CACAO."""

    SOURCE = MILK


#: Names of the entry points in version 0.1.0, which an environment installed then still has.
make_pyrtc_mirror, make_milk_mirror = PyrtcMirror, MilkMirror
